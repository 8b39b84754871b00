"""What the vehicle's feedback means: error bits in words, and when odometry no longer tells where the vehicle is."""

import pytest

from drivers.errors import DeadlineError, DeviceFault
from drivers.interfaces import LinkStatistics
from drivers.vehicle.agilex_link import VersionAnswer
from drivers.vehicle.faults import driver_trouble, system_trouble
from drivers.vehicle.feedback import CAN_MODE, STILL_FRAMES, MessageFeedback
from tests.support.inner_bus import Hand


class Bench:
    def __init__(self) -> None:
        self.clock = Hand()
        self.feedback = MessageFeedback(
            "vehicle", self.clock, track=0.58, max_speed=0.5, max_yaw_rate=0.5, statistics=LinkStatistics()
        )
        self.notify(0, 0)

    def notify(
        self, left: int, right: int, bits: int = 0, mode: int = CAN_MODE, state: int = 0, speed: float = 0.0
    ) -> None:
        """One round of cyclic messages, 20 ms after the last."""
        self.clock.time += 0.02
        self.feedback.take("Odometry", {"Left": left, "Right": right})
        self.feedback.take("MotionState", {"Speed": speed, "YawRate": 0.0})
        self.feedback.take("SystemState", {"State": state, "Mode": mode, "BatteryVoltage": 26.0, "ErrorBits": bits})

    def interruption(self) -> tuple[int, str]:
        state = self.feedback.state(1.0, None)
        return state.interruptions, state.interruption


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize(
    ("bits", "words"),
    [
        (0x0001, ("the battery's voltage is too low",)),
        (0x0008, ("motor 1 does not communicate",)),
        (0x0140, ("motor 4 does not communicate", "a motor driver fails")),
        (0x0006, ()),  # battery low and no remote control: it drives all the same
        (0x0800, ("bit 0x0800",)),
    ],
)
def test_error_bits_are_told_in_the_makers_words(bits: int, words: tuple[str, ...]):
    assert system_trouble(bits, commanded=True) == words
    bench = Bench()
    bench.notify(0, 0, bits=bits)
    if not words:
        bench.feedback.check(in_command=True, driving=False)
        return
    with pytest.raises(DeviceFault, match=words[0]) as caught:
        bench.feedback.check(in_command=True, driving=False)
    assert caught.value.code == "vehicle.error"


def test_an_error_that_came_while_driving_is_for_a_person_to_look_at(bench: Bench):
    """It may be a collision; one that came while it stood is cleared by a program."""
    for driven in (True, False):
        if driven:
            bench.feedback.commanded_to_move()
        else:
            bench.clock.time += 5.0
        bench.notify(0, 0, bits=0x0100, state=2)
        with pytest.raises(DeviceFault, match="a motor driver fails") as caught:
            bench.feedback.check(in_command=True, driving=False)
        assert caught.value.recoverable is not driven
        assert ("driven against" in caught.value.hint) is driven


def test_a_motor_drivers_overload_is_a_fault_and_being_enabled_is_none():
    assert driver_trouble(3, 0x44) == ("motor 3: overloaded",)
    bench = Bench()
    bench.feedback.take("MotorDriver2", {"DriverStatus": 0x40})
    bench.feedback.check(in_command=True, driving=False)
    bench.feedback.take("MotorDriver2", {"DriverStatus": 0x50})
    with pytest.raises(DeviceFault, match="motor 2: sensor fails"):
        bench.feedback.check(in_command=False, driving=False)


@pytest.mark.parametrize("mode", [0, 3])
def test_whoever_took_command_away_is_for_a_person_to_find_out(bench: Bench, mode: int):
    bench.notify(0, 0, mode=mode)
    bench.feedback.check(in_command=False, driving=False)
    with pytest.raises(DeviceFault, match="left CAN command") as caught:
        bench.feedback.check(in_command=True, driving=False)
    assert (caught.value.code, caught.value.recoverable) == ("vehicle.command_lost", False)
    assert bench.interruption()[0] == 1


def test_silence_is_a_fault_at_once_for_one_who_drives_and_when_it_is_sure_for_one_who_stands(bench: Bench):
    bench.clock.time += 0.6
    with pytest.raises(DeviceFault, match=r"no feedback for 0\.60 s") as caught:
        bench.feedback.check(in_command=True, driving=True)
    assert caught.value.code == "vehicle.silent"
    with pytest.raises(DeadlineError, match=r"0\.60 s old"):
        bench.feedback.state(0.2, None)
    bench.feedback.check(in_command=True, driving=False)  # this program may have read late
    for _ in range(25):
        bench.feedback.idle(0.1)
    with pytest.raises(DeviceFault, match="no feedback"):
        bench.feedback.check(in_command=True, driving=False)


def test_a_message_that_stopped_is_missed_though_the_others_go_on(bench: Bench):
    for _ in range(25):
        bench.clock.time += 0.001
        bench.feedback.idle(0.1)
        bench.feedback.take("Odometry", {"Left": 0, "Right": 0})
        bench.feedback.take("MotionState", {"Speed": 0.0, "YawRate": 0.0})
    with pytest.raises(DeviceFault, match=r"no feedback .*\(SystemState"):
        bench.feedback.check(in_command=True, driving=False)
    assert bench.interruption() == (0, "")


@pytest.mark.parametrize("late", ["Odometry", "MotionState", "SystemState"])
def test_a_reading_is_as_old_as_the_oldest_of_what_it_is_made_of(bench: Bench, late: str):
    kept = bench.feedback.get(late)
    bench.clock.time += 0.5
    bench.notify(0, 0)
    bench.feedback._newest[late] = kept
    with pytest.raises(DeadlineError, match=r"s old, allowed 0\.20 s"):
        bench.feedback.state(0.2, None)
    stamp = bench.feedback.state(1.0, None).stamp
    assert stamp == pytest.approx(bench.clock.time if late == "SystemState" else kept[0])


@pytest.mark.parametrize(("speed", "yaw_rate"), [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1)])
def test_a_vehicle_that_rolls_back_or_turns_does_not_stand(bench: Bench, speed: float, yaw_rate: float):
    asked = bench.clock.time
    assert not bench.feedback.stands(asked)  # what was told before says nothing
    for _ in range(STILL_FRAMES):
        bench.notify(0, 0)
    assert bench.feedback.stands(asked)
    bench.clock.time += 0.02
    bench.feedback.take("MotionState", {"Speed": speed, "YawRate": yaw_rate})
    assert not bench.feedback.stands(asked)


@pytest.mark.parametrize(("speeds", "way"), [((0.0, 0.2), 0), ((0.0, 0.0, 0.0, 0.2), 0), ((0.0,), 3), ((0.0,), -3)])
def test_a_stop_is_confirmed_by_feedback_that_agrees_with_itself(bench: Bench, speeds: tuple[float, ...], way: int):
    """Not by frames of standstill between others, and not while the wheels count on."""
    bench.feedback.commanded_to_move()
    bench.notify(0, 0, speed=0.2)
    for k in range(24):
        bench.notify(way * k, way * k, speed=speeds[k % len(speeds)])
        assert not bench.feedback.stands(0.0)
    for k in range(5):
        bench.notify(way * 23 + k % 2, way * 23)
    assert bench.feedback.stands(0.0)


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize(("other", "step"), [(12_000, 0), (0, 6), (-40, 6), (12_000, 6)])
def test_two_series_of_counts_are_two_vehicles(bench: Bench, other: int, step: int, every: int):
    """Whether one stands beside the other or far off, and however seldom the second tells: within 0.5 s."""
    bench.feedback.commanded_to_move()
    with pytest.raises(DeviceFault, match="two vehicles report under the same identifiers") as met:
        for k in range(25):
            bench.notify(100 + step * k, 100 + step * k)
            if k % every == 0:
                bench.clock.time -= 0.02
                bench.notify(100 + other, 100 + other)
            bench.feedback.check(in_command=False, driving=False)
    assert (met.value.code, met.value.recoverable) == ("vehicle.two_vehicles", False)
    bench.feedback.acknowledge()  # while it goes on, nobody takes command
    with pytest.raises(DeviceFault):
        bench.feedback.require_one()
    for _ in range(40):
        bench.notify(100, 100)
    bench.feedback.acknowledge()
    bench.feedback.check(in_command=True, driving=True)


def test_a_speed_that_wavers_by_three_millimetres_a_second_is_standstill(bench: Bench):
    bench.feedback.commanded_to_move()
    for waver in (0.003, -0.003, 0.001, -0.002, 0.003, 0.0, -0.003, 0.002):
        bench.notify(0, 0, speed=waver)
    assert bench.feedback.stands(0.0)


def test_a_low_battery_and_a_missing_remote_control_are_warnings(bench: Bench):
    bench.notify(0, 0, bits=0x0002 | 0x0004)
    assert bench.feedback.state(1.0, None).warnings == ("the battery is low", "no signal of the remote control")


def test_command_is_taken_only_once_the_vehicle_says_so_afterwards_and_without_a_fault(bench: Bench):
    asked = bench.clock.time
    assert not bench.feedback.commanded(asked)
    for wrong in ({"mode": 0}, {"mode": 3}, {"state": 1}, {"state": 2}, {"bits": 0x0100}):
        bench.notify(0, 0, **wrong)
        assert not bench.feedback.commanded(asked), wrong
    bench.notify(0, 0)
    assert bench.feedback.commanded(asked)


def test_an_emergency_stop_is_told_whoever_is_in_command_and_no_program_clears_it():
    for in_command in (True, False):
        bench = Bench()
        bench.notify(0, 0, state=1)
        with pytest.raises(DeviceFault, match="emergency stop") as caught:
            bench.feedback.check(in_command=in_command, driving=False)
        assert caught.value.code == "vehicle.emergency_stop"
        assert not caught.value.recoverable


@pytest.mark.parametrize(
    ("message", "signals"),
    [
        ("MotionCommand", {"Speed": 0.1, "YawRate": 0.0}),
        ("MotionCommand", {"Speed": 0.0, "YawRate": -0.1}),
        ("BrakeCommand", {"Locked": 0}),
    ],
)
def test_whoever_else_commands_it_is_noticed_and_takes_its_place_along(
    bench: Bench, message: str, signals: dict[str, float]
):
    bench.feedback.take("MotionCommand", {"Speed": 0.0, "YawRate": 0.0})
    bench.feedback.take("BrakeCommand", {"Locked": 1})
    bench.feedback.check(in_command=True, driving=False)
    bench.feedback.take(message, signals)
    with pytest.raises(DeviceFault, match="somebody else") as caught:
        bench.feedback.check(in_command=True, driving=False)
    assert not caught.value.recoverable
    assert bench.interruption()[0] == 1


@pytest.mark.parametrize("pushed", [(-6, 0), (0, 6), (0, -6)])
def test_each_wheel_tells_of_a_push_either_way(bench: Bench, pushed: tuple[int, int]):
    bench.notify(0, 0)
    bench.notify(*pushed)
    assert bench.interruption() == (1, "it moved by 6 mm without a command")


def test_odometry_that_jumps_or_stays_away_no_longer_tells_the_place(bench: Bench):
    for count in range(50):
        bench.feedback.commanded_to_move()
        bench.notify(10 * count, 10 * count)
    assert bench.interruption() == (0, "")
    bench.notify(0, 0)  # switched off and on: 490 mm are gone
    assert bench.interruption() == (1, "its odometers jumped, so it was restarted")
    bench.clock.time += 2.2  # this program computed, what came meanwhile waits
    bench.notify(0, 0)
    assert bench.interruption()[0] == 1
    for _ in range(22):
        bench.feedback.idle(0.1)
    bench.notify(0, 0)
    assert bench.interruption() == (2, "nothing was heard of it for 2.2 s")


def test_a_vehicle_that_is_pushed_while_nobody_commands_it_is_noticed(bench: Bench):
    for _ in range(10):
        bench.notify(0, 0)
    bench.notify(4, 3)
    assert bench.interruption()[0] == 0
    bench.notify(9, 8)
    assert bench.interruption() == (1, "it moved by 9 mm without a command")
    with pytest.raises(DeviceFault, match="moved by 9 mm") as caught:
        bench.feedback.check(in_command=True, driving=False)
    assert caught.value.code == "vehicle.disturbed"
    bench.feedback.check(in_command=False, driving=False)


@pytest.mark.parametrize("after", [0.02, 1.0, 1.9, 60.0])
def test_a_restart_is_noticed_however_long_its_feedback_stayed_away(bench: Bench, after: float):
    """It counts from zero again; while it was away it cannot have driven, since nobody commanded it."""
    for count in range(50):
        bench.feedback.commanded_to_move()
        bench.notify(10 * count, 10 * count)
    for _ in range(250):
        bench.notify(490, 490)
    assert bench.interruption()[0] == 0
    bench.clock.time += after
    bench.notify(0, 0)
    assert bench.interruption()[0] >= 1
    assert bench.feedback.state(1.0, None).x == pytest.approx(0.49)


def test_in_a_gap_it_can_have_driven_until_it_rests_after_its_last_command():
    """At 0.5 m/s and 0.5 rad/s a side counts 0.645 m in a second; it rests 4 s after its last command."""
    for gap, counted, lost in ((1.0, 600, False), (1.0, 720, True), (100.0, 2500, False), (100.0, 2700, True)):
        bench = Bench()
        bench.feedback.commanded_to_move()
        bench.clock.time += gap
        bench.notify(counted, counted)
        assert bench.feedback.state(1.0, None).x == pytest.approx(0.0 if lost else 1e-3 * counted), (gap, counted)
        assert bench.interruption()[0] >= 1 or not lost


def test_what_moves_by_our_own_command_is_no_push(bench: Bench):
    bench.feedback.commanded_to_move()
    for count in range(150):
        bench.notify(8 * count, 8 * count)
    bench.clock.time += 0.9
    for _ in range(200):
        bench.notify(8 * 149, 8 * 149)
    assert bench.interruption() == (0, "")


def test_a_version_text_shorter_than_its_frames_is_that_text_and_no_row_of_zeros():
    answer = VersionAnswer()
    for part in [b"SCOUT V2", b".3-1\0\0\0\0", *[bytes(8)] * 8]:
        assert not answer.is_complete()
        words = (int.from_bytes(part[k : k + 2], "big") for k in range(0, 8, 2))
        names = ("ControllerHardware", "DriverHardware", "ControllerSoftware", "DriverSoftware")
        answer.take("VersionResponse", dict(zip(names, words, strict=True)))
    assert answer.is_complete()
    assert answer.describe() == "SCOUT V2.3-1"


@pytest.mark.parametrize("message", ["VersionNumbers", "VersionResponse"])
def test_a_version_may_be_told_in_numbers_under_either_identifier(message: str):
    answer = VersionAnswer()
    numbers = {"ControllerHardware": 2, "DriverHardware": 1, "ControllerSoftware": 0x2041, "DriverSoftware": 110}
    answer.take(message, numbers)
    assert answer.is_complete()
    assert answer.describe() == "hardware 2/1, controller 8257, drivers 110"

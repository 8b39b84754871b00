"""What a CANopen drive's numbers mean: states, emergencies, units, and readings that belong together."""

import math
import struct
from dataclasses import replace

import pytest

from drivers.errors import DeadlineError, DeviceFault
from drivers.interfaces import LinkStatistics
from drivers.vehicle.cia402.drive import HEARTBEAT, MOTION, STATUS
from drivers.vehicle.cia402.feedback import AT_REST, CREPT_M, DriveFeedback, UnitCheck, WheelDrives
from tests.support.inner_bus import Hand

WHEELS = WheelDrives((1, 2), 0.1, 20.0, 4096, "0.1 rpm", (False, True), 0.58, 0.5, 1.0)


def test_metres_a_second_become_numbers_of_the_drives():
    """0.3 m/s on a wheel of 100 mm is 28.65 turns a minute, behind a gear of 20 572.96."""
    assert WHEELS.targets(0.3, 0.0) == (5730, -5730)
    assert WHEELS.targets(0.0, 1.0) == (-5539, -5539)  # 0.29 m/s of the rims, against each other
    assert WHEELS.motion((5730, -5730)) == pytest.approx((0.3, 0.0), abs=3e-5)
    assert (WHEELS.count_length, WHEELS.ramp(1.0)) == (pytest.approx(2 * math.pi * 0.1 / 81920), 19099)


def test_readings_of_two_different_moments_are_not_one_pose():
    """One drive's reading is lost: each later pair is of one SYNC again, not left of one and right of the next."""
    clock = Hand()
    feedback = DriveFeedback("vehicle", clock, WHEELS, max_speed=0.5, max_yaw_rate=0.8, statistics=LinkStatistics())

    def notify(node: int, count: int) -> None:
        clock.time += 0.001
        sign = -1 if node == 2 else 1
        feedback.take(node, MOTION, struct.pack("<i", 0))
        feedback.take(node, STATUS, struct.pack("<Hib", 0x0237, sign * count, 3))

    feedback.commanded_to_move()
    for k in range(20):
        if k != 7:
            notify(1, 600 * k)
        notify(2, 600 * k)
        clock.time += 0.018
        feedback.commanded_to_move()
        state = feedback.state(10.0, None, True)
        assert state.yaw == 0.0
    assert state.x == pytest.approx(19 * 600 * WHEELS.count_length)


class Told:
    """Both drives as this program has heard of them; each `tell` is one round of one drive."""

    def __init__(self, wheels: WheelDrives = WHEELS) -> None:
        self.clock = Hand()
        self.feedback = DriveFeedback(
            "vehicle", self.clock, wheels, max_speed=0.5, max_yaw_rate=0.8, statistics=LinkStatistics()
        )
        for drive in self.feedback.drives:
            drive.configured = True
        for node in (1, 2):
            self.notify(node)

    def notify(
        self, node: int, velocity: int = 0, word: int = 0x0237, mode: int = 3, inputs: int = 0, count: int = 0
    ) -> None:
        self.clock.time += 0.001
        self.feedback.take(node, MOTION, struct.pack("<iI", velocity, inputs))
        self.feedback.take(node, STATUS, struct.pack("<Hib", word, count, mode))

    def refusal(self, *, in_command: bool = True, driving: bool = False) -> DeviceFault:
        with pytest.raises(DeviceFault) as caught:
            self.feedback.check(in_command=in_command, driving=driving)
        return caught.value


@pytest.mark.parametrize("node", [1, 2])
@pytest.mark.parametrize("velocity", [300, -300])
def test_one_wheel_that_turns_either_way_is_no_standstill(node: int, velocity: int):
    told = Told()
    for _ in range(AT_REST):
        asked = told.clock.time
        told.notify(node)
        assert not told.feedback.stands(asked), "the other one has told nothing since"
        told.notify(3 - node)
    assert told.feedback.stands(asked)
    told.notify(node, velocity)
    assert not told.feedback.stands(asked)


@pytest.mark.parametrize("node", [1, 2])
@pytest.mark.parametrize("way", [1, -1])
def test_counts_that_go_on_deny_a_speed_of_zero(node: int, way: int):
    told = Told()
    asked, step = told.clock.time, round(1.2 * CREPT_M / WHEELS.count_length)
    for k in range(1, 3 * AT_REST):
        told.notify(node, count=way * k * step)
        told.notify(3 - node)
        assert not told.feedback.stands(asked)
    for k in range(AT_REST):
        # It hunts by some counts.
        told.notify(node, count=way * (3 * AT_REST - 1) * step + 3 * (k % 2))
        told.notify(3 - node)
    assert told.feedback.stands(asked)


@pytest.mark.parametrize("node", [1, 2])
def test_one_drive_that_falls_silent_is_noticed_though_the_other_tells_on(node: int):
    told = Told()
    side = told.feedback.drives[node - 1].side
    last = told.feedback.drives[node - 1].moved
    told.clock.time += 0.6
    told.notify(3 - node)
    fault = told.refusal(driving=True)
    assert (fault.code, side in fault.message) == ("vehicle.silent", True)
    with pytest.raises(DeadlineError, match=r"0\.60 s old"):
        told.feedback.state(0.2, True, True)
    assert told.feedback.state(1.0, True, True).stamp == pytest.approx(last)


@pytest.mark.parametrize("node", [1, 2])
@pytest.mark.parametrize("active", [True, False])
def test_either_drives_input_tells_of_the_emergency_stop(node: int, active: bool):
    told = Told(replace(WHEELS, stop_input=3, stop_active=active))
    free, pressed = (0, 1 << 3) if active else (1 << 3, 0)
    for each in (1, 2):
        told.notify(each, inputs=free)
    told.feedback.check(in_command=True, driving=True)
    told.notify(node, inputs=pressed)
    for in_command in (True, False):
        fault = told.refusal(in_command=in_command)
        assert (fault.code, fault.recoverable) == ("vehicle.emergency_stop", False)
    assert told.feedback.state(1.0, True, True).emergency_stop


@pytest.mark.parametrize("node", [1, 2])
@pytest.mark.parametrize(
    ("word", "mode", "why"),
    [
        (0x0037, 3, "commanded locally"),
        (0x0237, 1, "mode 1 instead of 3"),
        (0x0233, 3, "left operation"),
        (0x0217, 3, "left operation"),
    ],
)
def test_one_drive_that_does_not_obey_ends_driving(node: int, word: int, mode: int, why: str):
    told = Told()
    assert told.feedback.gave_up() is None and told.feedback.state(1.0, False, True).command_mode
    told.notify(node, word=word, mode=mode)
    fault = told.feedback.gave_up()
    assert fault is not None
    assert why in fault.message and told.feedback.drives[node - 1].side in fault.message
    assert not told.feedback.state(1.0, False, True).command_mode


def test_a_drive_that_was_restarted_does_not_obey():
    told = Told()
    told.feedback.take(2, HEARTBEAT, b"\0")
    told.notify(2)
    fault = told.feedback.gave_up()
    assert fault is not None
    assert "was restarted" in fault.message
    assert told.feedback.interruptions == 1


def test_a_wrong_unit_is_told_and_an_offset_or_a_gap_is_none():
    clock = Hand()
    step = round(0.3 / WHEELS.count_length * 0.02)

    def ratio(velocity: int, seconds: float = 2.0, period: float = 0.02, moves: bool = True) -> float:
        check, position = UnitCheck(clock, WHEELS), 0
        found = 0.0
        for _ in range(round(seconds / period)):
            clock.time += period
            position += round(step * period / 0.02) * moves
            found = found or check.contradiction(clock.time, position, velocity)
        return found

    assert (ratio(5730), ratio(57300)) == (0.0, pytest.approx(10.0, rel=0.01))
    assert (ratio(-5730), ratio(20, 3600.0, 0.05, moves=False)) == (pytest.approx(-1.0, rel=0.01), 0.0)
    assert ratio(57300, period=0.15) == 0.0

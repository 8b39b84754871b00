"""The interlocks' rules by readings that are written down here: each direction, each part of a reading, each limit."""

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cell.devices.gate.gated import GuardedMotion
from cell.devices.gate.interlocks import DeviceCommand, Interlocks, Situation
from cell.devices.gate.rules import LATE_S, LOOK_M, LOOK_RAD, RULES
from cell.measure.geometry.poses import to_ur
from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceFault, InterlockError
from drivers.interfaces import ArmSafety, ArmState, VehicleState

MOVE = DeviceCommand("arm", "move_joints", {"joints": np.zeros(6)})
DRIVE = DeviceCommand("vehicle", "drive", {"speed": 0.1, "yaw_rate": 0.0})
POSTURE = np.zeros(6)
LOOK = pin.SE3(np.eye(3), np.array([0.4, 0.0, 0.6]))
STANDS = VehicleState(
    stamp=0.0, x=0.0, y=0.0, yaw=0.0, speed=0.0, yaw_rate=0.0, command_mode=True, braked=True, emergency_stop=False,
    error_bits=0, battery_volts=26.0,
)  # fmt: skip


class Told:
    """A device that tells this, however old it may be."""

    def __init__(self, name: str, state: Any) -> None:
        self.name, self.newest = name, state
        self.asked: list[float] = []

    def state(self, max_age: float = 0.1) -> Any:
        self.asked.append(max_age)
        return self.newest


class Ended:
    """A motion of the arm that is over, or not."""

    contact = False

    def __init__(self, done: bool) -> None:
        self.done = done

    def wait(self, timeout: float) -> None:
        pass


def arm_state(**shown: Any) -> ArmState:
    still = np.zeros(6)
    known = ArmState(
        stamp=Clock().now(), joints=POSTURE, joint_speeds=still, flange=to_ur(LOOK), wrench=still,
        safety=ArmSafety.NORMAL, moving=False, digital_inputs=0, digital_outputs=0, device_time=0.0, controlled=True,
    )  # fmt: skip
    return replace(known, **shown)


def rules(vehicle: VehicleState = STANDS, arm: ArmState | None = None, **known: Any) -> Interlocks:
    """A cell whose devices tell this; the arm's model has the flange at `LOOK`, whatever its joints."""
    situation = Situation(
        Told("arm", arm or arm_state()), Told("vehicle", vehicle), None, None, {},  # type: ignore[arg-type]
        lambda joints, command, others: (), lambda joints: LOOK, {"HOME": POSTURE}, "", clock=Clock(),
    )  # fmt: skip
    for name, value in known.items():
        setattr(situation, name, value)
    return Interlocks(situation, RULES)


def test_what_is_written_down_here_lets_arm_and_vehicle_move():
    rules().require(MOVE)
    rules().require(DRIVE)


@pytest.mark.parametrize(
    "moving", [{"speed": 0.006}, {"speed": -0.006}, {"yaw_rate": 0.006}, {"yaw_rate": -0.006},
               {"speed": math.nan}, {"yaw_rate": math.nan}], ids=str
)  # fmt: skip
def test_a_vehicle_that_rolls_or_turns_either_way_is_not_parked(moving: dict[str, float]):
    with pytest.raises(InterlockError, match=r"vehicle drives at .*vehicle_parked"):
        rules(replace(STANDS, **moving)).require(MOVE)


@pytest.mark.parametrize("braked", [False, None])
def test_a_brake_that_is_open_or_not_known_is_not_locked(braked: bool | None):
    with pytest.raises(InterlockError, match="vehicle_parked"):
        rules(replace(STANDS, braked=braked)).require(MOVE)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("speed", [0.06, -0.06, math.nan])
def test_an_arm_that_turns_any_joint_either_way_is_not_stowed(joint: int, speed: float):
    turning = arm_state(joint_speeds=np.where(np.arange(6) == joint, speed, 0.0))
    with pytest.raises(InterlockError, match=r"the arm moves.*arm_stowed"):
        rules(arm=turning).require(DRIVE)
    with pytest.raises(InterlockError, match=r"the arm moves.*arm_still"):
        rules(arm=turning).require(DeviceCommand("vehicle", "enable"))
    for command in ("grip", "release"):
        with pytest.raises(InterlockError, match=r"the arm moves.*claw_at_rest"):
            rules(arm=turning).require(DeviceCommand("claw", command))


def test_an_arm_whose_motion_is_not_over_is_not_stowed_though_it_stands():
    with pytest.raises(InterlockError, match=r"the arm moves.*arm_stowed"):
        rules(last=Ended(False)).require(DRIVE)
    rules(last=Ended(True)).require(DRIVE)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("off", [math.radians(2.1), -math.radians(2.1)])
def test_one_joint_off_is_another_posture(joint: int, off: float):
    with pytest.raises(InterlockError, match=r"2\.1 deg from HOME.*arm_stowed"):
        rules(arm=arm_state(joints=off * np.eye(6)[joint])).require(DRIVE)


@pytest.mark.parametrize(
    ("shift", "turn", "fits"),
    [(0.9 * LOOK_M, 0.0, True), (0.0, 0.9 * LOOK_RAD, True), (1.1 * LOOK_M, 0.0, False), (0.0, 1.1 * LOOK_RAD, False)],
)
def test_a_looking_pose_is_one_by_its_place_and_by_its_turn(shift: float, turn: float, fits: bool):
    look = LOOK * pin.SE3(pin.exp3(np.array([0.0, turn, 0.0])), np.array([0.0, 0.0, -shift]))
    interlocks = rules(arm=arm_state(joints=POSTURE + 1.0), looks={"the job's": look})
    with nullcontext() if fits else pytest.raises(InterlockError, match="arm_stowed"):
        interlocks.require(DRIVE)


@pytest.mark.parametrize(
    ("shift", "turn", "same"),
    [(0.04e-3, 0.0, True), (0.0, 0.09e-3, True), (-0.06e-3, 0.0, False), (0.0, -0.11e-3, False)],
)
def test_the_flange_is_compared_in_place_and_in_turn(shift: float, turn: float, same: bool):
    told = LOOK * pin.SE3(pin.exp3(np.array([0.0, 0.0, turn])), np.array([0.0, shift, 0.0]))
    with nullcontext() if same else pytest.raises(InterlockError, match="same_kinematics"):
        rules(arm=arm_state(flange=to_ur(told))).require(MOVE)


class Late(Told):
    """A vehicle whose newest reading is too old for the first `silent` times that it is asked."""

    def __init__(self, silent: float, braked: bool, fault: bool) -> None:
        super().__init__("vehicle", replace(STANDS, braked=braked))
        self.silent, self.fault = silent, fault

    def state(self, max_age: float = 0.1) -> Any:
        self.silent -= 1
        if self.silent >= 0 and max_age < math.inf:
            raise DeadlineError(self.name, "its newest reading is old")
        return self.newest

    def check(self) -> None:
        if self.fault:
            raise DeviceFault(self.name, "vehicle.silent", "it is silent", recoverable=True, hint="")


@pytest.mark.parametrize(
    ("vehicle", "error"),
    [(Late(2, True, True), None), (Late(math.inf, True, False), None), (Late(math.inf, True, True), DeviceFault),
     (Late(math.inf, False, False), DeadlineError)],
)  # fmt: skip
def test_a_late_reading_is_waited_for_and_an_old_one_is_enough_of_a_vehicle_that_is_braked_and_not_silent(
    vehicle: Late, error: type[Exception] | None
):
    with nullcontext() if error is None else pytest.raises(error):
        interlocks = rules()
        interlocks.situation.vehicle = vehicle  # type: ignore[assignment]
        interlocks.require(MOVE)


def test_driving_is_judged_by_the_arms_newest_state_without_waiting_for_another():
    """The arm is shaken a little as the vehicle drives; the laser's output shows in the same state."""
    shaken = arm_state(joint_speeds=np.full(6, 0.02), moving=True)
    interlocks = rules(arm=shaken, laser=Told("laser", None), outputs={0: "laser"})
    interlocks.require(DRIVE)
    arm: Any = interlocks.situation.arm
    assert set(arm.asked) == {math.inf}
    arm.newest = arm_state(digital_outputs=1)
    with pytest.raises(InterlockError, match="laser_off_to_drive"):
        interlocks.require(DRIVE)


def test_nothing_drives_by_an_old_state_of_the_arm():
    old = arm_state(stamp=Clock().now() - LATE_S - 0.1)
    with pytest.raises(DeadlineError, match="newest state is"):
        rules(arm=old).require(DRIVE)
    rules(arm=old).require(DeviceCommand("vehicle", "drive", {"speed": 0.0, "yaw_rate": 0.0}))


@pytest.mark.parametrize(
    ("index", "value", "refused"),
    [(0, True, True), (0, False, False), (1, True, True), (1, False, True), (2, True, False), (2, False, False)],
)
def test_of_the_outputs_of_others_the_lasers_alone_may_be_switched_off(index: int, value: bool, refused: bool):
    interlocks = rules(outputs={0: "laser", 1: "claw"})
    command = DeviceCommand("arm", "set_digital_output", {"index": index, "value": value})
    own = pytest.raises(InterlockError, match=rf"output {index} is the .*'s\. Use the .*own_switch")
    with own if refused else nullcontext():
        interlocks.require(command)


def test_a_rule_is_lifted_inside_its_context_only():
    interlocks = rules(replace(STANDS, speed=0.1))
    with interlocks.lifted(["vehicle_parked"]):
        interlocks.require(MOVE)
        with interlocks.lifted(["way_clear"]):
            interlocks.require(MOVE)
        interlocks.require(MOVE)
    with pytest.raises(InterlockError, match="vehicle_parked"):
        interlocks.require(MOVE)


@pytest.mark.parametrize(
    ("holding", "held"), [(None, True), (True, True), (False, False)], ids=["none", "part", "empty"]
)
def test_the_part_is_in_the_way_unless_the_claws_switch_shows_none(holding: bool | None, held: bool):
    """Without a claw nothing tells: what a run has said is believed."""
    about: list[Any] = []
    claw = None if holding is None else Told("claw", None)
    if claw is not None:
        claw.holding = holding
    rules(
        claw=claw, part=("part",), station=("station",), clear=lambda joints, command, others: about.extend(others)
    ).require(MOVE)
    assert about == ["part", "station"] if held else about == ["station"]


def test_a_contact_at_which_nobody_saw_the_arm_stand_opens_no_claw():
    claw = Told("claw", None)
    claw.holding = True
    ended = Ended(True)
    ended.contact = True
    arm = Told("arm", arm_state())
    guarded = GuardedMotion(ended, arm)  # type: ignore[arg-type]
    interlocks = rules(claw=claw, last=guarded)
    with pytest.raises(InterlockError, match=r"nobody has seen where the arm stood.*claw_at_contact"):
        interlocks.require(DeviceCommand("claw", "release"))
    guarded.wait(1.0)
    interlocks.require(DeviceCommand("claw", "release"))
    # Moved by hand from there, whoever waits for the motion again.
    arm.newest = arm_state(joints=POSTURE + 0.1)
    guarded.wait(1.0)
    np.testing.assert_array_equal(guarded.rest, POSTURE)


def test_a_motion_that_felt_nothing_ends_nowhere_at_contact():
    free = GuardedMotion(Ended(True), Told("arm", arm_state()))  # type: ignore[arg-type]
    free.wait(1.0)
    assert (free.contact, free.rest) == (False, None)


def test_what_the_laser_is_lit_for_holds_inside_its_context_only():
    interlocks = rules()
    light = DeviceCommand("laser", "lit")
    with interlocks.purpose("sweep"), ThreadPoolExecutor(1) as other:
        with interlocks.purpose("test"):
            pass
        interlocks.require(light)
        # Another thread has said nothing.
        assert isinstance(other.submit(interlocks.require, light).exception(), InterlockError)
    with pytest.raises(InterlockError, match="laser_purpose"):
        interlocks.require(light)


def test_an_output_is_tried_inside_its_context_only():
    interlocks = rules(outputs={0: "laser", 1: "claw"})
    with interlocks.tried(2):
        with interlocks.tried(3):
            pass
        assert [interlocks.may_be_laser(output) for output in range(4)] == [True, False, True, False]
    assert [interlocks.may_be_laser(output) for output in range(4)] == [True, False, False, False]


def test_an_arm_that_can_hears_which_output_is_tried():
    """Should this process be killed, the server switches that output off."""
    heard: list[str] = []

    class Trying(Told):
        @contextmanager
        def trying(self, output: int) -> Iterator[None]:
            heard.append(f"begin {output}")
            yield
            heard.append(f"end {output}")

    interlocks = rules()
    interlocks.situation.arm = Trying("arm", arm_state())  # type: ignore[assignment]
    with interlocks.tried(2):
        assert heard == ["begin 2"]
    assert heard == ["begin 2", "end 2"]


def test_a_lit_laser_bars_driving_and_not_the_end_of_it():
    lit = Told("laser", None)
    lit.is_on = True
    with pytest.raises(InterlockError, match="laser_off_to_drive"):
        rules(laser=lit).require(DRIVE)
    rules(laser=lit).require(DeviceCommand("vehicle", "drive", {"speed": 0.0, "yaw_rate": 0.0}))

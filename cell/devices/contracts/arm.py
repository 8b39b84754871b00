"""What the cell relies on in an arm. The suite moves it, by as much as the bench says."""

import numpy as np
import pytest

from cell.devices.contracts.device import Bench, DeviceContract
from drivers.errors import Aborted, DeadlineError, DeviceFault, InterlockError, LimitError
from drivers.interfaces import Arm, ArmSafety, Vector

TURN_RAD, TURN_SPEED, ACCELERATION = 0.2, 0.2, 0.8
"""Way, speed and acceleration of the suite's motions at full motion: of the last joint alone, which moves no mass."""
TIMEOUT_S = 60.0
FREE_OUTPUT = 7
"""A standard output that nothing hangs on."""


def turned(joints: Vector, by: float) -> Vector:
    """These joint angles with the last joint turned `by` rad."""
    goal = joints.copy()
    goal[5] += by
    return goal


class ArmContract(DeviceContract):
    """An arm in its normal state whose last joint has 0.2 rad of room either way, and whose output 7 is free."""

    def test_a_state_is_fresh_and_in_si(self, bench: Bench[Arm]) -> None:
        """Six angles in rad, a flange in m and rad, stamped with the host's time."""
        arm = bench.device
        asked = bench.clock.now()
        state = arm.state()
        assert asked - 0.15 <= state.stamp <= bench.clock.now() + 0.01
        assert state.joints.shape == state.joint_speeds.shape == state.flange.shape == state.wrench.shape == (6,)
        assert np.abs(state.joints).max() <= 2 * np.pi + 0.1
        assert np.abs(state.flange[:3]).max() < 3.0
        assert state.safety is ArmSafety.NORMAL
        assert not state.moving
        bench.clock.sleep(0.1)
        assert arm.state().device_time > state.device_time

    def test_a_motion_ends_where_it_was_sent_at_its_speed(self, bench: Bench[Arm]) -> None:
        """In rad and rad/s; the others stay."""
        arm, way = bench.device, TURN_RAD * bench.motion
        took: list[float] = []
        start = arm.state().joints
        for goal in (turned(start, way), start):
            with bench.timed(took):
                arm.move_joints(goal, TURN_SPEED * bench.motion, ACCELERATION).wait(TIMEOUT_S)
            assert arm.state().joints == pytest.approx(goal, abs=2e-3)
            assert not arm.state().moving
        assert 0.9 * TURN_RAD / TURN_SPEED <= took[0] < 2.0 * TURN_RAD / TURN_SPEED + 3.0

    def test_a_trajectory_is_followed_from_where_the_arm_stands(self, bench: Bench[Arm]) -> None:
        """One that begins elsewhere is an `InterlockError`."""
        arm, way = bench.device, TURN_RAD * bench.motion
        start = arm.state().joints
        times = np.linspace(0.0, 2.0, 201)
        smooth = 0.5 - 0.5 * np.cos(np.pi * times / 2.0)
        with pytest.raises(InterlockError):
            arm.follow(times, np.array([turned(start, 0.1 + way * s) for s in smooth]))
        motion = arm.follow(times, np.array([turned(start, way * s) for s in smooth]))
        motion.wait(TIMEOUT_S)
        assert not motion.contact
        assert arm.state().joints == pytest.approx(turned(start, way), abs=2e-3)
        arm.move_joints(start, TURN_SPEED * bench.motion, ACCELERATION).wait(TIMEOUT_S)

    def test_limits_are_kept_before_anything_is_sent(self, bench: Bench[Arm]) -> None:
        """`LimitError`, and nothing has moved."""
        arm = bench.device
        start = arm.state().joints
        for beyond in (
            lambda: arm.move_joints(turned(start, 50.0), TURN_SPEED, ACCELERATION),
            lambda: arm.move_joints(turned(start, 0.1), 100.0, ACCELERATION),
            lambda: arm.move_joints(turned(start, 0.1), -TURN_SPEED, ACCELERATION),
            lambda: arm.move_linear(np.array([9.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.1, 0.5),
            lambda: arm.set_digital_output(99, True),
        ):
            with pytest.raises(LimitError):
                beyond()
        assert arm.state().joints == pytest.approx(start, abs=1e-3)

    def test_a_stop_overtakes_a_motion_and_the_next_one_begins(self, bench: Bench[Arm]) -> None:
        """`Aborted` for whoever waits; a second motion meanwhile is an `InterlockError`."""
        arm, way = bench.device, TURN_RAD * bench.motion
        start = arm.state().joints
        motion = arm.move_joints(turned(start, way), 0.25 * TURN_SPEED * bench.motion, ACCELERATION)
        bench.clock.sleep(1.0)
        with pytest.raises(InterlockError):
            arm.move_joints(start, TURN_SPEED * bench.motion, ACCELERATION)
        arm.stop()
        with pytest.raises(Aborted):
            motion.wait(TIMEOUT_S)
        stood = arm.state().joints
        assert 0.0 < stood[5] - start[5] < way
        arm.move_joints(start, TURN_SPEED * bench.motion, ACCELERATION).wait(TIMEOUT_S)
        assert arm.state().joints == pytest.approx(start, abs=2e-3)

    def test_a_deadline_stops_the_motion(self, bench: Bench[Arm]) -> None:
        """`DeadlineError`, and it stands."""
        arm = bench.device
        start = arm.state().joints
        motion = arm.move_joints(turned(start, TURN_RAD * bench.motion), 0.25 * TURN_SPEED * bench.motion, ACCELERATION)
        with pytest.raises(DeadlineError):
            motion.wait(1.0)
        bench.clock.sleep(1.0)
        assert not arm.state().moving
        arm.move_joints(start, TURN_SPEED * bench.motion, ACCELERATION).wait(TIMEOUT_S)

    def test_an_output_shows_once_it_was_set(self, bench: Bench[Arm]) -> None:
        """And no other changes."""
        arm = bench.device
        before = arm.state().digital_outputs
        for value in (True, True, False):
            arm.set_digital_output(FREE_OUTPUT, value)
            assert arm.state().digital_outputs == before & ~(1 << FREE_OUTPUT) | value << FREE_OUTPUT
        assert arm.digital_input(0) in (True, False)

    def test_every_state_is_recorded_in_order(self, bench: Bench[Arm]) -> None:
        """While the context is open."""
        arm = bench.device
        with arm.record() as states:
            bench.clock.sleep(0.5)
        times = [state.device_time for state in states]
        assert len(times) >= 5
        assert times == sorted(times)

    def test_a_fault_on_the_way_is_told_by_its_code_and_a_person_ends_it(self, bench: Bench[Arm]) -> None:
        """Nothing moves then, a stop changes nothing, and `recover` wants a person's word."""
        arm, way, code = bench.device, TURN_RAD * bench.motion, "arm.protective_stop"
        start = arm.state().joints
        with bench.faulty() as faults:
            motion = arm.move_joints(turned(start, way), 0.25 * TURN_SPEED * bench.motion, ACCELERATION)
            bench.clock.sleep(1.0)
            faults.cause(code)
            with pytest.raises(DeviceFault) as met:
                motion.wait(TIMEOUT_S)
            assert (met.value.code, met.value.recoverable) == (code, True)
            arm.stop()
            arm.stop()
            stood = arm.state()
            assert stood.safety is ArmSafety.PROTECTIVE_STOP
            assert not stood.moving
            for begin in (lambda: arm.move_joints(start, TURN_SPEED, ACCELERATION), arm.recover):
                with pytest.raises(DeviceFault) as again:
                    begin()
                assert again.value.code == code
            assert arm.state().joints == pytest.approx(stood.joints, abs=1e-3)
            arm.recover(confirmed=True)
        arm.move_joints(start, TURN_SPEED * bench.motion, ACCELERATION).wait(TIMEOUT_S)
        assert arm.state().safety is ArmSafety.NORMAL
        assert arm.state().joints == pytest.approx(start, abs=2e-3)

    def test_an_end_after_a_fault_leaves_nothing_going_on(self, bench: Bench[Arm]) -> None:
        """Connected anew, it stands where it stood, and says what is the matter."""
        arm = bench.device
        start = arm.state().joints
        with bench.faulty() as faults:
            arm.move_joints(turned(start, TURN_RAD * bench.motion), 0.25 * TURN_SPEED * bench.motion, ACCELERATION)
            bench.clock.sleep(1.0)
            faults.cause("arm.protective_stop")
            bench.over()
            bench.clock.sleep(1.0)
            faults.clear()
            arm = bench.device
            stood = arm.state().joints
            bench.clock.sleep(1.0)
            assert arm.state().joints == pytest.approx(stood, abs=1e-3)
            assert not arm.state().moving
        arm.recover(confirmed=True)
        arm.move_joints(start, TURN_SPEED * bench.motion, ACCELERATION).wait(TIMEOUT_S)

    def test_recovering_an_arm_that_is_well_leaves_it_ready(self, bench: Bench[Arm]) -> None:
        """It moves afterwards."""
        arm = bench.device
        arm.recover()
        start = arm.state().joints
        arm.move_joints(turned(start, 0.02 * bench.motion), TURN_SPEED, ACCELERATION).wait(TIMEOUT_S)
        arm.move_joints(start, TURN_SPEED, ACCELERATION).wait(TIMEOUT_S)

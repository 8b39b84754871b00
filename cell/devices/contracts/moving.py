"""What the cell relies on in a rail, an arm and a vehicle. The suites move them, by as much as the bench says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cell.devices.contracts.device import Bench, DeviceContract
from drivers.errors import Aborted, DeadlineError, DeviceFault, InterlockError, LimitError
from drivers.interfaces import LONGEST_NUDGE_M, Arm, ArmSafety, ChecksZero, Nudged, Rail, Vector, Vehicle

FAR_M, RAIL_SPEED = 0.03, 0.02
"""Way in m and speed in m/s of the suite's motions at full motion; its rail takes ten times the speed."""
HOMES_S = 90.0
"""The longest that a homing, or a way to the other end, may take."""
STANDS_S = 1.0
EXACT_M = 2e-5


class RailContract(DeviceContract):
    """A rail whose travel begins at or below 0 and is longer than 0.06 m. It homes."""

    def homed(self, bench: Bench[Rail]) -> Rail:
        """The rail, homed, at position 0."""
        rail = bench.device
        if not rail.state().homed_here:
            rail.home().wait(HOMES_S)
        rail.move_to(max(0.0, rail.travel[0])).wait(HOMES_S)
        return rail

    def stands(self, bench: Bench[Rail]) -> None:
        """A stop comes back when the rail has taken it: a moment later it stands."""
        until = bench.clock.now() + STANDS_S
        while bench.device.state().moving:
            assert bench.clock.now() < until
            bench.clock.sleep(0.02)

    def test_a_rail_that_is_not_homed_goes_nowhere(self, bench: Bench[Rail]) -> None:
        """`InterlockError`, since positions mean nothing yet."""
        rail = bench.device
        if rail.state().homed:
            pytest.skip("it remembers an earlier homing")
        before = rail.state().position
        with pytest.raises(InterlockError):
            rail.move_to(0.0)
        assert rail.state().position == before

    def test_a_little_may_be_moved_before_its_zero_is_known(self, bench: Bench[Rail]) -> None:
        """Where a rail offers it: by that way, no farther than 10 mm, and it is no more homed than before."""
        rail = bench.device
        if not isinstance(rail, Nudged):
            pytest.skip("it moves only when it is homed")
        if rail.state().homed:
            pytest.skip("it remembers an earlier homing")
        before = rail.state()
        way = 0.002 if before.right_switch <= before.left_switch else -0.002
        rail.nudge(way, 0.005).wait(HOMES_S)
        assert rail.state().position == pytest.approx(before.position + way, abs=EXACT_M)
        assert not rail.state().homed
        with pytest.raises(LimitError):
            rail.nudge(1.1 * LONGEST_NUDGE_M, 0.005)
        rail.nudge(-way, 0.005).wait(HOMES_S)

    def test_homing_ends_at_zero_at_rest(self, bench: Bench[Rail]) -> None:
        """Position 0 is at the switch."""
        rail = bench.device
        rail.home().wait(HOMES_S)
        state = rail.state()
        assert state.homed
        assert state.homed_here
        assert not state.moving
        assert abs(state.position) < 1e-3

    def test_positions_are_metres_and_speeds_metres_a_second(self, bench: Bench[Rail]) -> None:
        """A move ends where it was sent, and takes the time of its way at its speed."""
        rail, way, speed = self.homed(bench), FAR_M * bench.motion, RAIL_SPEED * bench.motion
        took: list[float] = []
        with bench.timed(took):
            rail.move_to(way, speed).wait(HOMES_S)
        assert rail.state().position == pytest.approx(way, abs=EXACT_M)
        assert way / speed <= took[0] + 0.05 < 1.5 * way / speed + 2.0

    def test_limits_are_kept_before_anything_is_sent(self, bench: Bench[Rail]) -> None:
        """`LimitError`, and the carriage has not moved."""
        rail = self.homed(bench)
        low, high = rail.travel
        before = rail.state().position
        for beyond in (lambda: rail.move_to(high + 0.001), lambda: rail.move_to(low - 0.001),
                       lambda: rail.move_to(0.01, 100.0), lambda: rail.move_to(0.01, -0.01),
                       lambda: rail.move_to(0.01, 0.0), lambda: rail.sweep_start(low, high, RAIL_SPEED)):  # fmt: skip
            with pytest.raises(LimitError):
                beyond()
        assert rail.state().position == pytest.approx(before, abs=EXACT_M)
        assert not rail.state().moving

    def test_a_stop_overtakes_a_motion(self, bench: Bench[Rail]) -> None:
        """It stands short of its goal, and whoever waits is told by `Aborted`."""
        rail, way = self.homed(bench), FAR_M * bench.motion
        motion = rail.move_to(way, 0.2 * RAIL_SPEED * bench.motion)
        with pytest.raises(InterlockError):
            rail.move_to(0.0)
        bench.clock.sleep(0.5)
        rail.stop()
        with pytest.raises(Aborted):
            motion.wait(HOMES_S)
        assert motion.done
        self.stands(bench)
        state = rail.state()
        assert 0.0 < state.position < way
        assert rail.state().position == pytest.approx(state.position, abs=EXACT_M)

    def test_a_deadline_stops_the_motion(self, bench: Bench[Rail]) -> None:
        """`wait` raises `DeadlineError` for a motion that does not arrive in time, and it is stopped."""
        rail = self.homed(bench)
        motion = rail.move_to(FAR_M * bench.motion, 0.2 * RAIL_SPEED * bench.motion)
        with pytest.raises(DeadlineError):
            motion.wait(0.5)
        self.stands(bench)
        rail.move_to(0.0).wait(HOMES_S)

    def test_a_reset_on_the_way_is_told_by_its_code_and_homing_ends_it(self, bench: Bench[Rail]) -> None:
        """Its zero is lost: until it was homed, it goes nowhere; a stop changes nothing."""
        rail = self.homed(bench)
        with bench.faulty() as faults:
            motion = rail.move_to(FAR_M * bench.motion, 0.2 * RAIL_SPEED * bench.motion)
            bench.clock.sleep(0.5)
            faults.cause("rail.reset")
            with pytest.raises(DeviceFault) as met:
                motion.wait(HOMES_S)
            assert (met.value.code, met.value.recoverable) == ("rail.reset", True)
            rail.stop()
            rail.stop()
            assert not rail.state().moving
            assert not rail.state().homed
            with pytest.raises(InterlockError):
                rail.move_to(0.0)
        rail.home().wait(HOMES_S)
        rail.move_to(FAR_M * bench.motion).wait(HOMES_S)
        assert rail.state().position == pytest.approx(FAR_M * bench.motion, abs=EXACT_M)

    def test_steps_that_were_lost_show_at_the_reference_switch_and_end_the_trust_in_the_zero(
        self, bench: Bench[Rail]
    ) -> None:
        """Where a rail offers to look: a sound one ends at 0, one that lost steps is refused till it homes."""
        rail = self.homed(bench)
        if not isinstance(rail, ChecksZero) or (sound := rail.check_zero()) is None:
            pytest.skip("its reference switch is not shown")
        sound.wait(HOMES_S)
        assert rail.state().position == pytest.approx(0.0, abs=EXACT_M)
        for way in (0.003, 0.06):
            with bench.faulty() as faults:
                faults.cause("rail.lost_steps")
                rail.move_to(way).wait(HOMES_S)
            with pytest.raises(DeviceFault, match="lost steps since it was homed") as met:
                check = rail.check_zero()
                assert check is not None
                check.wait(HOMES_S)
            assert met.value.code == "rail.lost_steps"
            with pytest.raises(InterlockError, match="not homed"):
                rail.move_to(way)
            rail.home().wait(HOMES_S)

    def test_exchanged_limit_switches_are_named_before_the_end_stop(self, bench: Bench[Rail]) -> None:
        """Beyond its travel the wrong one trips: it is stopped at once, and told which."""
        if not isinstance(bench.device, Nudged):
            pytest.skip("it moves only within its travel")
        rail = self.homed(bench)
        with bench.faulty() as faults:
            faults.cause("rail.exchanged_switches")
            with pytest.raises(DeviceFault) as met:
                bench.device.nudge(-0.006, 0.001).wait(HOMES_S)
            if met.value.code != "rail.switches" and not rail.state().right_switch:
                pytest.skip("it does not tell its limit switches")
            assert (met.value.code, met.value.recoverable) == ("rail.switches", False)
            assert "right limit switch tripped" in str(met.value)
            self.stands(bench)
            assert rail.state().position > -0.0035
        rail.home().wait(HOMES_S)

    def test_time_stamps_are_of_the_host_when_the_position_held(self, bench: Bench[Rail]) -> None:
        """Between the question and the answer, and never backwards."""
        rail, stamps = self.homed(bench), []
        for _ in range(5):
            asked = bench.clock.now()
            stamps.append(rail.state().stamp)
            assert asked <= stamps[-1]
            bench.clock.sleep(0.02)
            assert stamps[-1] <= bench.clock.now()
        assert stamps == sorted(stamps)

    def test_a_sweep_has_constant_velocity_in_its_window(self, bench: Bench[Rail]) -> None:
        """`position_at` runs from `start` to `stop` at the speed that was asked for; outside it is a ValueError."""
        rail, speed = self.homed(bench), RAIL_SPEED * bench.motion
        start, stop = 0.01, 0.01 + FAR_M * bench.motion
        with pytest.raises(InterlockError):
            rail.sweep(start, stop, speed)
        rail.move_to(rail.sweep_start(start, stop, speed)).wait(HOMES_S)
        sweep = rail.sweep(start, stop, speed)
        sweep.wait(HOMES_S)
        begin, end = sweep.window
        assert (end - begin) == pytest.approx((stop - start) / speed, rel=0.02)
        times = np.linspace(begin, end, 9)[1:-1]
        places = [sweep.position_at(float(time)) for time in times]
        assert np.polyfit(times, places, 1)[0] == pytest.approx(speed, rel=0.02)
        assert start - 2e-4 <= places[0] < places[-1] <= stop + 2e-4
        assert sweep.samples.shape[1] == 2
        assert sweep.time_bound >= 0.0
        with pytest.raises(ValueError, match=r".+"):
            sweep.position_at(end + 60.0)


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


DRIVE_SPEED, TIME_S, PERIOD_S = 0.1, 2.0, 0.05


class VehicleContract(DeviceContract):
    """A vehicle without fault that has 0.3 m of room ahead and behind."""

    def drive(self, bench: Bench[Vehicle], speed: float, seconds: float) -> None:
        """Keep a velocity for so long."""
        until = bench.clock.now() + seconds
        while bench.clock.now() < until:
            bench.device.drive(speed, 0.0)
            bench.clock.sleep(PERIOD_S)

    def gone(self, bench: Bench[Vehicle], since: tuple[float, float]) -> float:
        """Metres by odometry."""
        state = bench.device.state(1.0)
        return math.hypot(state.x - since[0], state.y - since[1])

    def here(self, bench: Bench[Vehicle]) -> tuple[float, float]:
        """By odometry, m."""
        state = bench.device.state(1.0)
        return state.x, state.y

    def test_who_is_not_enabled_or_is_braked_is_not_driven(self, bench: Bench[Vehicle]) -> None:
        """`InterlockError`, and it stands; `brake` twice is as once."""
        vehicle, here = bench.device, self.here(bench)
        vehicle.brake()
        vehicle.brake()
        with pytest.raises(InterlockError):
            vehicle.drive(DRIVE_SPEED, 0.0)
        state = vehicle.state(1.0)
        assert state.braked
        assert state.speed == 0.0
        assert self.gone(bench, here) < 1e-3

    def test_speeds_are_metres_a_second_and_odometry_metres(self, bench: Bench[Vehicle]) -> None:
        """It goes as far as its speed and the time say, and comes back."""
        vehicle, speed = bench.device, DRIVE_SPEED * bench.motion
        vehicle.enable()
        here = self.here(bench)
        self.drive(bench, speed, TIME_S)
        assert vehicle.state(1.0).speed == pytest.approx(speed, abs=0.3 * speed + 0.01)
        vehicle.brake()
        way = self.gone(bench, here)
        assert way == pytest.approx(speed * TIME_S, rel=0.4, abs=0.02)
        vehicle.enable()
        self.drive(bench, -speed, TIME_S)
        vehicle.brake()
        assert self.gone(bench, here) < 0.4 * way + 0.02

    def test_limits_are_kept_before_anything_is_sent(self, bench: Bench[Vehicle]) -> None:
        """`LimitError`, and it stands."""
        vehicle, here = bench.device, self.here(bench)
        vehicle.enable()
        for speed, turning in ((100.0, 0.0), (-100.0, 0.0), (0.0, 100.0)):
            with pytest.raises(LimitError):
                vehicle.drive(speed, turning)
        vehicle.brake()
        assert self.gone(bench, here) < 1e-3

    def test_a_velocity_that_nobody_renews_becomes_zero(self, bench: Bench[Vehicle]) -> None:
        """Within half a second, and the time to slow down."""
        vehicle = bench.device
        vehicle.enable()
        self.drive(bench, DRIVE_SPEED * bench.motion, 0.5)
        bench.clock.sleep(1.5)
        assert abs(vehicle.state(1.0).speed) < 0.01
        self.drive(bench, -DRIVE_SPEED * bench.motion, 0.5)
        vehicle.brake()

    def test_a_stop_overtakes_and_leaves_it_enabled(self, bench: Bench[Vehicle]) -> None:
        """It stands when `stop` comes back."""
        vehicle = bench.device
        vehicle.enable()
        self.drive(bench, DRIVE_SPEED * bench.motion, 0.5)
        vehicle.stop()
        assert abs(vehicle.state(1.0).speed) < 0.01
        self.drive(bench, -DRIVE_SPEED * bench.motion, 0.5)
        vehicle.brake()

    @pytest.mark.parametrize("code", ["vehicle.emergency_stop", "vehicle.motor_fault"])
    def test_a_fault_on_the_way_stands_it_still_and_is_told(self, bench: Bench[Vehicle], code: str) -> None:
        """By every command and `check`, until its cause is gone and it was recovered; a stop changes nothing."""
        vehicle = bench.device
        vehicle.enable()
        self.drive(bench, DRIVE_SPEED * bench.motion, 0.5)
        with bench.faulty() as faults:
            faults.cause(code)
            with pytest.raises(DeviceFault) as met:
                self.drive(bench, DRIVE_SPEED * bench.motion, 3.0)
            told = met.value.code
            assert told.startswith("vehicle.")
            vehicle.stop()
            vehicle.stop()
            assert abs(vehicle.state(1.0).speed) < 0.01
            with pytest.raises(DeviceFault, match=told):
                vehicle.check()
            assert vehicle.state(1.0).emergency_stop == (code == "vehicle.emergency_stop")
        vehicle.recover()
        vehicle.check()
        assert vehicle.state(1.0).braked
        vehicle.enable()
        self.drive(bench, -DRIVE_SPEED * bench.motion, 0.5)
        vehicle.brake()

    def test_an_end_after_a_fault_leaves_it_standing(self, bench: Bench[Vehicle]) -> None:
        """Connected anew, it stands, and is well once what caused the fault is gone."""
        bench.device.enable()
        self.drive(bench, DRIVE_SPEED * bench.motion, 0.5)
        with bench.faulty() as faults:
            faults.cause("vehicle.emergency_stop")
            bench.over()
            bench.clock.sleep(1.0)
            here = self.here(bench)
            bench.clock.sleep(0.5)
            assert self.gone(bench, here) < 1e-3
        bench.device.recover()
        bench.device.enable()
        self.drive(bench, -DRIVE_SPEED * bench.motion, 0.5)
        bench.device.brake()

    def test_a_state_is_fresh_and_a_sound_vehicle_has_no_fault(self, bench: Bench[Vehicle]) -> None:
        """Stamped with the host's time; `recover` locks the brake."""
        vehicle = bench.device
        vehicle.recover()
        vehicle.check()
        state = vehicle.state(1.0)
        assert bench.clock.now() - 1.1 <= state.stamp <= bench.clock.now() + 0.01
        assert state.braked
        assert not state.emergency_stop

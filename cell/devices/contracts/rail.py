"""What the cell relies on in a rail. The suite moves it, by as much as the bench says."""

import numpy as np
import pytest

from cell.devices.contracts.device import Bench, DeviceContract
from drivers.errors import Aborted, DeadlineError, DeviceFault, InterlockError, LimitError
from drivers.interfaces import LONGEST_NUDGE_M, ChecksZero, Nudged, Rail

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

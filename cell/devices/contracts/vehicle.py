"""What the cell relies on in a vehicle. The suite moves it, by as much as the bench says."""

import math

import pytest

from cell.devices.contracts.device import Bench, DeviceContract
from drivers.errors import DeviceFault, InterlockError, LimitError
from drivers.interfaces import Vehicle

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
        """`InterlockError`, and it stands; the brake counts as locked once the vehicle is in command."""
        vehicle, here = bench.device, self.here(bench)
        for hold in (vehicle.brake, vehicle.recover):
            hold()
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

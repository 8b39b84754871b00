"""The vehicle's driver on the simulated CAN bus, its odometry and its stops against the simulated vehicle."""

import math
import time

import can
import pytest

from drivers.errors import DeviceFault, InterlockError
from tests.support.wire.vehicle_bench import STANDSTILL, Bench, benched
from tests.unit.drivers.vehicle import conftest

pytestmark = pytest.mark.wire


bench, enabled = conftest.bench, conftest.enabled


def test_it_drives_as_told_and_odometry_follows(enabled: Bench):
    enabled.drive_for(3.0, 0.3, 0.4)
    state = enabled.vehicle.state()
    assert (state.speed, state.yaw_rate) == pytest.approx((0.3, 0.4), abs=0.005)
    enabled.vehicle.stop()
    assert enabled.true_speed() <= STANDSTILL
    x, y, yaw = enabled.truth()
    assert math.hypot(x, y) > 0.5
    enabled.until(lambda: abs(enabled.vehicle.state().x - x) < 0.003)
    state = enabled.vehicle.state()
    assert (state.x, state.y) == pytest.approx((x, y), abs=0.005)
    assert state.yaw == pytest.approx(yaw, abs=0.005)


def test_recovering_clears_the_error_with_the_brake_locked_all_along(enabled: Bench):
    enabled.vehicle.brake()
    enabled.until(lambda: enabled.model.feedback(enabled.world.now()).braked)
    enabled.peer.fault("vehicle.motor_fault")
    enabled.until(lambda: bool(enabled.vehicle.state().error_bits))
    released = []
    enabled.model.set_brake = lambda t, locked: released.append(not locked)  # type: ignore[method-assign]
    enabled.vehicle.recover()
    enabled.clock.sleep(0.2)
    enabled.vehicle.check()
    assert not any(released)
    with pytest.raises(InterlockError, match="brake is locked"):
        enabled.vehicle.drive(0.1, 0.0)


class Recorder(can.Listener):
    """What was on the bus, with the times at which an adapter of its own heard it."""

    def __init__(self) -> None:
        self.frames: list[tuple[float, int, bytes]] = []

    def on_message_received(self, message: can.Message) -> None:
        self.frames.append((time.monotonic(), message.arbitration_id, bytes(message.data)))

    def first(self, identifier: int, data: bytes) -> float:
        """When the first frame came that begins so."""
        return next(
            (at for at, number, all_ in self.frames if number == identifier and all_.startswith(data)), math.nan
        )


@pytest.mark.parametrize(
    ("fault", "mark", "code", "asked"),
    [
        ("can.foreign_commands", (0x111, b"\x00\xc8"), "vehicle.disturbed", False),
        ("can.foreign_commands", (0x111, b"\x00\xc8"), "vehicle.disturbed", True),
        ("can.second_vehicle", (0x311, b"\x00\x00\x2e\xe0"), "vehicle.two_vehicles", False),
    ],
)
def test_it_is_braked_first_against_others_on_the_bus(fault: str, mark: tuple[int, bytes], code: str, asked: bool):
    """It locks the brake within 0.2 s of the first foreign frame, by itself, whether it is `asked` meanwhile or not."""
    with benched(1.0) as made, can.Bus(interface="slcan", channel=made.peer.channel, sleep_after_open=0) as bus:
        recorder = Recorder()
        notifier = can.Notifier(bus, [recorder], 0.02)
        vehicle, here = made.vehicle, 0.0
        try:
            vehicle.enable()
            made.drive_for(0.8, 0.3)
            here = made.truth()[0]
            made.peer.fault(fault)
            if asked:
                with pytest.raises(DeviceFault):
                    while made.clock.sleep(0.002) is None:
                        vehicle.check()
            made.until(lambda: not math.isnan(recorder.first(0x131, b"\x01")))
            assert 0.0 < recorder.first(0x131, b"\x01") - recorder.first(*mark) < 0.2
            with pytest.raises(DeviceFault if not asked else (DeviceFault, InterlockError)) as met:
                vehicle.drive(0.1, 0.0)
            assert asked or (met.value.code, met.value.recoverable) == (code, False)
            assert recorder.frames[-1][0] - recorder.first(*mark) < 0.5
            begun = made.clock.now()
            if code == "vehicle.disturbed":
                vehicle.brake()
            else:
                # One of the two says that it stands: nobody knows of which that is true.
                with pytest.raises(DeviceFault, match=r"left and right (12000|\d+) and (11500|\d+) mm"):
                    vehicle.brake()
                assert made.clock.now() - begun < 0.2
                with pytest.raises(DeviceFault, match="two vehicles report"):
                    vehicle.enable()
            assert made.model.feedback(made.world.now()).braked
            made.until(lambda: made.true_speed() == 0.0, 1.0)
            assert made.clock.now() - begun < 3.0
            assert made.truth()[0] - here < 0.12
            made.peer.clear()
            made.clock.sleep(0.6)
            vehicle.enable()
            made.drive_for(0.3, 0.2)
            vehicle.stop()
        finally:
            notifier.stop()


def test_a_driver_that_never_took_command_knows_nothing_of_the_brake_and_sends_no_motion(bench: Bench):
    assert bench.vehicle.state().braked is None
    with can.Bus(interface="slcan", channel=bench.peer.channel, sleep_after_open=0, timeout=0.02) as observer:
        bench.vehicle.close()
        seen = set()
        while (message := observer.recv(0.3)) is not None and len(seen) < 12:
            seen.add(message.arbitration_id)
    assert 0x111 not in seen

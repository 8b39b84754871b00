"""Promises of `drivers.vehicle.can_link`."""

from typing import Any

import can
import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceFault, NotConnectedError
from drivers.vehicle.agilex import LOCKS, AgilexVehicle
from tests.support.wire.vehicle_bench import TRACK, Bench, benched, threads

pytestmark = pytest.mark.wire


def test_a_dead_bus_is_a_fault_and_enabling_opens_it_again(enabled: Bench):
    enabled.drive_for(0.5, 0.3)
    enabled.peer.fault("can.bus_off")
    with pytest.raises(DeviceFault, match="CAN bus") as caught:
        enabled.drive_for(2.0, 0.3)
    assert caught.value.code == "vehicle.link_lost"
    with pytest.raises(DeviceFault):
        enabled.vehicle.state()
    with pytest.raises(DeviceFault):
        enabled.vehicle.stop()
    # Without commands the vehicle stops by itself.
    enabled.until(lambda: enabled.true_speed() == 0.0)
    enabled.vehicle.enable()
    assert enabled.vehicle.state().interruption == "the CAN bus failed and was opened again"
    enabled.drive_for(0.5, 0.3)
    assert enabled.true_speed() > 0.0
    x, _, _ = enabled.truth()
    # Odometry has counted the way that was rolled while the bus was down.
    assert enabled.vehicle.state().x == pytest.approx(x, abs=0.05)
    assert enabled.vehicle.statistics.errors["link_lost"] == 1
    assert enabled.vehicle.statistics.errors["reopened"] == 1


def test_a_bus_that_cannot_be_opened_yet_is_opened_by_the_next_recovery(enabled: Bench, monkeypatch):
    def unplugged(**settings: object) -> can.BusABC:
        raise can.CanInitializationError("no such adapter")

    enabled.peer.fault("can.bus_off")
    enabled.until(lambda: not enabled.vehicle._link.alive)
    with monkeypatch.context() as patch:
        patch.setattr(can, "Bus", unplugged)
        with pytest.raises(NotConnectedError, match="no such adapter"):
            enabled.vehicle.recover()
        with pytest.raises(DeviceFault, match="cell recover"):
            enabled.vehicle.check()
    enabled.vehicle.recover()
    assert enabled.vehicle.state().braked


def test_an_adapter_that_refuses_every_frame_is_a_fault_within_half_a_second():
    with benched(1.0) as made:
        made.vehicle.enable()
        made.drive_for(0.3, 0.2)
        made.peer.fault("can.refused_frames")
        begun = made.clock.now()
        with pytest.raises(DeviceFault, match=r"the adapter refuses every frame, \d+ in a row") as met:
            made.drive_for(2.0, 0.2)
        assert made.clock.now() - begun < 0.5
        assert met.value.code == "vehicle.link_lost"
        made.peer.clear()
        made.vehicle.enable()
        made.drive_for(0.3, 0.2)


@pytest.mark.parametrize("refused", [LOCKS - 1, 1000])
def test_a_lock_that_the_adapter_refuses_is_not_taken_as_locked_and_sent_again(refused: int):
    left = refused
    with benched(1.0) as made:
        take, state = made.peer._bus._command, made.vehicle.state

        def some(adapter: Any, line: bytes) -> None:
            nonlocal left
            if line.startswith(b"t131101") and left > 0:
                left -= 1
                adapter.put(b"\a")
            else:
                take(adapter, line)

        made.vehicle.enable()
        made.peer._bus._command = some  # type: ignore[method-assign]
        made.vehicle.brake()
        if refused > LOCKS:
            made.until(lambda: state().braked is None)
            made.clock.sleep(0.1)
            assert {state().braked for _ in range(1000)} == {None}
            left = 0
        made.until(lambda: made.model.feedback(made.world.now()).braked)
        made.until(lambda: state().braked is True)


def test_commands_come_every_20_ms_and_closing_ends_them():
    with (
        benched(1.0) as made,
        can.Bus(interface="slcan", channel=made.peer.channel, sleep_after_open=0, timeout=0.005) as observer,
    ):
        made.vehicle.enable()
        stamps: list[float] = []
        while len(stamps) < 20:
            message = observer.recv(1.0)
            assert message is not None
            if message.arbitration_id == 0x111:
                stamps.append(message.timestamp)
        assert np.median(np.diff(stamps)) == pytest.approx(0.020, abs=0.006)
        made.vehicle.close()
        assert threads() == []


def test_nobody_on_the_bus_is_named():
    with pytest.raises(NotConnectedError, match="no vehicle reports on virtual:empty"):
        AgilexVehicle("vehicle", "virtual", "empty", track=TRACK, max_speed=1.0, max_yaw_rate=1.0, clock=Clock())
    with pytest.raises(NotConnectedError, match="cannot be opened"):
        AgilexVehicle(
            "vehicle", "slcan", "socket://127.0.0.1:1", track=TRACK, max_speed=1.0, max_yaw_rate=1.0, clock=Clock()
        )
    with pytest.raises(ConfigError, match="carrier-pigeon"):
        AgilexVehicle("vehicle", "carrier-pigeon", "x", track=TRACK, max_speed=1.0, max_yaw_rate=1.0, clock=Clock())

"""The simulated AgileX vehicle on its bus, through python-can and the shared DBC."""

import struct
from collections import Counter
from typing import Any

import can
import cantools
import numpy as np
import pytest

from sim_backends.clock import WorldClock
from sim_backends.models.vehicle import Mode, VehicleModel, VehicleParams
from sim_backends.peers.vehicle.agilex import AgilexPeer
from tests.support import ROOT
from tests.support.simulator.can_bus import message, open_bus, receive

pytestmark = pytest.mark.wire
DBC = ROOT / "drivers" / "vehicle" / "agilex_v2.dbc"


def test_the_vehicle_drives_at_the_commanded_speed(bus: can.BusABC, model: VehicleModel, clock: WorldClock):
    bus.send(message(0x421, [1, 0, 0, 0, 0, 0, 0, 0]))
    receive(bus, lambda f: f.arbitration_id == 0x211 and f.data[1] == 1)
    end = clock.now() + 1.5
    while clock.now() < end:
        bus.send(message(0x111, [0x00, 0x96, 0, 0, 0, 0, 0, 0]))
        clock.sleep(0.02)
    moving = receive(bus, lambda f: f.arbitration_id == 0x221 and f.data[:2] == b"\x00\x96")
    assert moving.data[2:] == bytes(6)
    assert model.feedback(clock.now()).speed == pytest.approx(0.15)
    receive(bus, lambda f: f.arbitration_id == 0x221 and f.data == bytes(8))
    odometry = receive(bus, lambda f: f.arbitration_id == 0x311)
    left, right = struct.unpack(">ii", odometry.data)
    assert left == right == round(1000 * model.feedback(clock.now()).left)
    assert left > 150


def test_feedback_means_the_same_in_the_shared_dbc(bus: can.BusABC, model: VehicleModel, clock: WorldClock):
    database = cantools.database.load_file(DBC)
    model.set_mode(clock.now(), Mode.CAN)
    model.fault("vehicle.motor_fault", clock.now())
    names = {"SystemState", "MotionState", "Odometry", "BatteryState"}
    names |= {f"Motor{kind}{i}" for kind in ("Motion", "Driver") for i in (1, 2, 3, 4)}
    read: dict[str, Any] = {}
    wall = WorldClock()
    known = {m.frame_id: m for m in database.messages}
    while wall.now() < 20.0 and not (names <= set(read) and read["SystemState"]["ErrorBits"]):
        frame = bus.recv(0.1)
        if frame is not None and frame.arbitration_id in known:
            entry = known[frame.arbitration_id]
            assert frame.dlc == entry.length
            read[entry.name] = entry.decode(bytes(frame.data), decode_choices=False)
    assert names <= set(read)
    state = read["SystemState"]
    # ugv_sdk: SYSTEM_ERROR_MOTOR_DRIVER, DRIVER_STATE_DRIVER_ENABLED and …_DRIVER_FAULT.
    assert (state["State"], state["Mode"], state["ErrorBits"]) == (2, 1, 0x0100)
    assert read["MotorDriver2"]["DriverStatus"] == 0x40
    assert state["BatteryVoltage"] == read["BatteryState"]["Voltage"] == read["MotorDriver1"]["Voltage"]
    assert state["BatteryVoltage"] == pytest.approx(26.4)


@pytest.mark.parametrize(("speed", "fast", "slow"), [(1.0, 50, 50), (50.0, 200, 50)])
def test_feedback_keeps_its_cycles_and_does_not_flood_a_fast_world(speed: float, fast: int, slow: int):
    peer = AgilexPeer(VehicleModel(VehicleParams(), np.random.default_rng(1)), WorldClock(speed))
    peer.start()
    bus = open_bus(peer)

    def kept() -> bool:
        wall, seen = WorldClock(), Counter[int]()
        while wall.now() < 0.6:
            frame = bus.recv(0.05)
            seen[frame.arbitration_id if frame else 0] += 1
        rates = seen[0x221] / wall.now(), seen[0x251] / wall.now()
        return 0.5 * fast < rates[0] < 1.15 * fast and 0.5 * slow < rates[1] < 1.15 * slow

    try:
        receive(bus, lambda f: f.arbitration_id == 0x311)
        # A machine that is busy with something else may hold one look up.
        assert any(kept() for _ in range(20))
    finally:
        bus.shutdown()
        peer.stop()

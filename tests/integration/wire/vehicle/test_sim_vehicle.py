"""The simulated vehicle: its physics against closed forms, its bus through python-can and the shared DBC."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import can
import cantools
import numpy as np
import pytest

from sim_backends.clock import WorldClock
from sim_backends.models.vehicle import ChassisState, Mode, VehicleModel, VehicleParams
from sim_backends.peers.vehicle.agilex import AgilexPeer
from tests.support import ROOT
from tests.support.wire.clocks import until

DBC = ROOT / "drivers" / "vehicle" / "agilex_v2.dbc"


def vehicle(seed: int = 1, **params: Any) -> VehicleModel:
    return VehicleModel(VehicleParams(**params), np.random.default_rng(seed))


def drive(model: VehicleModel, begin: float, end: float, speed: float, yaw_rate: float = 0.0) -> None:
    for t in np.arange(begin, end - 1e-9, 0.02):
        model.command(float(t), speed, yaw_rate)
    model.tick(end)


# --- physics ---


def test_power_on_is_standby_where_commands_are_ignored() -> None:
    model = vehicle()
    drive(model, 0.0, 2.0, 0.5)
    assert model.feedback(2.0).mode is Mode.STANDBY
    assert model.planar(2.0) == (-3.05, 0.0, 0.0)


def test_speed_follows_the_acceleration_limit() -> None:
    model = vehicle(acceleration=0.6)
    model.set_mode(0.0, Mode.CAN)
    drive(model, 0.0, 1.0, 0.3)
    assert model.feedback(1.0).speed == pytest.approx(0.3)
    assert model.feedback(1.0).left == pytest.approx(0.3 * 1.0 - 0.3**2 / (2 * 0.6), abs=1e-3)


def test_without_commands_it_stops_after_half_a_second() -> None:
    model = vehicle(acceleration=0.6)
    model.set_mode(0.0, Mode.CAN)
    drive(model, 0.0, 2.0, 0.3)
    x = model.planar(2.0)[0]
    assert model.feedback(2.47).speed == pytest.approx(0.3)
    rest = 0.3 * 0.48 + 0.3**2 / (2 * 0.6)
    assert model.planar(10.0)[0] - x == pytest.approx(rest, abs=3e-3)
    assert model.feedback(10.0).speed == 0.0


def test_slip_is_seen_by_the_world_and_not_by_the_odometers() -> None:
    model = vehicle(distance_scale=1.03, yaw_scale=0.9)
    model.set_mode(0.0, Mode.CAN)
    drive(model, 0.0, 5.0, 0.3)
    model.tick(10.0)
    feedback, (x, y, yaw) = model.feedback(10.0), model.planar(10.0)
    assert (x + 3.05) / feedback.left == pytest.approx(1.03)
    assert (y, yaw, feedback.right) == pytest.approx((0.0, 0.0, feedback.left))
    drive(model, 10.0, 14.0, 0.0, 0.3)
    model.tick(20.0)
    turned = (model.feedback(20.0).right - model.feedback(20.0).left) / model.params.track
    assert model.planar(20.0)[2] == pytest.approx(0.9 * turned)
    assert turned > 1.0


def test_the_random_walk_grows_with_the_root_of_the_way() -> None:
    headings = []
    for seed in range(60):
        model = vehicle(seed, yaw_walk=0.01)
        model.set_mode(0.0, Mode.CAN)
        drive(model, 0.0, 4.0, 0.5)
        headings.append(model.planar(10.0)[2])
    way = model.feedback(10.0).left
    assert np.std(headings) == pytest.approx(0.01 * math.sqrt(way), rel=0.3)


def test_the_pose_is_known_between_ticks_and_carries_the_sag() -> None:
    model = vehicle(start=(1.0, 2.0, math.pi / 2))
    model.sag = lambda: (0.01, 0.02, -0.003)
    model.tick(1.0)
    pose = model.world_from_vehicle(1.0)
    np.testing.assert_allclose(pose[:3, 3], [1.0, 2.0, -0.003])
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    # Pitch about the body's y axis, which is world −x here, lowers the nose; roll about its x axis lifts its left side.
    assert pose[2, 0] == pytest.approx(-math.sin(0.02))
    assert pose[2, 1] == pytest.approx(math.cos(0.02) * math.sin(0.01))
    model.set_mode(1.0, Mode.CAN)
    drive(model, 1.0, 3.0, 0.2)
    early, late = model.world_from_vehicle(2.0), model.world_from_vehicle(2.01)
    assert late[1, 3] - early[1, 3] == pytest.approx(0.002, rel=0.01)


def test_brake_and_emergency_stop_stop_hard_and_hold() -> None:
    for act in ("brake", "emergency"):
        model = vehicle(brake_deceleration=2.5)
        model.set_mode(0.0, Mode.CAN)
        drive(model, 0.0, 2.0, 0.5)
        x = model.planar(2.0)[0]
        if act == "brake":
            model.set_brake(2.0, True)
        else:
            model.fault("vehicle.emergency_stop", 2.0)
        drive(model, 2.0, 4.0, 0.5)
        assert model.planar(4.0)[0] - x == pytest.approx(0.5**2 / (2 * 2.5), abs=2e-3)
        model.clear_errors(4.0)
        assert model.feedback(4.0).state is (ChassisState.OK if act == "brake" else ChassisState.EMERGENCY_STOP)
        model.set_brake(4.0, False)
        model.clear(4.0)
        drive(model, 4.0, 5.0, 0.5)
        assert model.feedback(5.0).speed > 0.4


# --- the wire ---


def message(identifier: int, data: list[int]) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def receive(bus: can.BusABC, wanted: Callable[[can.Message], bool], seconds: float = 20.0) -> can.Message:
    wall = WorldClock()
    while wall.now() < seconds:
        frame = bus.recv(0.1)
        if frame is not None and wanted(frame):
            return frame
    raise AssertionError("the frame did not come within the deadline")


def open_bus(peer: AgilexPeer) -> can.BusABC:
    return can.Bus(interface=peer.interface, channel=peer.channel, bitrate=500_000, sleep_after_open=0)


@pytest.fixture
def clock() -> WorldClock:
    return WorldClock(4.0)


@pytest.fixture
def model() -> VehicleModel:
    return vehicle()


@pytest.fixture
def peer(model: VehicleModel, clock: WorldClock) -> Iterator[AgilexPeer]:
    peer = AgilexPeer(model, clock)
    peer.start()
    yield peer
    peer.stop()


@pytest.fixture
def bus(peer: AgilexPeer) -> Iterator[can.BusABC]:
    bus = open_bus(peer)
    yield bus
    bus.shutdown()


@pytest.fixture
def adapter(peer: AgilexPeer) -> Iterator[socket.socket]:
    host, port = peer.channel.removeprefix("socket://").split(":")
    with socket.create_connection((host, int(port)), timeout=2.0) as adapter:
        yield adapter


def ask(adapter: socket.socket, line: bytes) -> bytes:
    adapter.sendall(line + b"\r")
    answer = b""
    while not answer.endswith((b"\r", b"\a")):
        answer += adapter.recv(1)
    return answer


@pytest.mark.wire
def test_the_vehicle_drives_at_the_commanded_speed(bus: can.BusABC, model: VehicleModel, clock: WorldClock) -> None:
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


@pytest.mark.wire
def test_feedback_means_the_same_in_the_shared_dbc(bus: can.BusABC, model: VehicleModel, clock: WorldClock) -> None:
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


@pytest.mark.wire
def test_the_shared_dbc_commands_the_vehicle(bus: can.BusABC, model: VehicleModel, clock: WorldClock) -> None:
    database = cantools.database.load_file(DBC)

    def send(name: str, **signals: float) -> None:
        entry = database.get_message_by_name(name)
        bus.send(message(entry.frame_id, list(entry.encode(signals))))

    send("ControlModeCommand", Mode=1)
    end = clock.now() + 1.0
    while clock.now() < end:
        send("MotionCommand", Speed=-0.2, YawRate=0.1, LateralSpeed=0, Steering=0)
        clock.sleep(0.02)
    feedback = model.feedback(clock.now())
    assert (feedback.speed, feedback.yaw_rate) == pytest.approx((-0.2, 0.1))
    send("BrakeCommand", Locked=1)
    until(clock, lambda: model.feedback(clock.now()).braked)


@pytest.mark.wire
@pytest.mark.parametrize(("speed", "fast", "slow"), [(1.0, 50, 50), (50.0, 200, 50)])
def test_feedback_keeps_its_cycles_and_does_not_flood_a_fast_world(speed: float, fast: int, slow: int) -> None:
    peer = AgilexPeer(vehicle(), WorldClock(speed))
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


@pytest.mark.wire
def test_all_clients_share_the_bus(peer: AgilexPeer, bus: can.BusABC) -> None:
    other = open_bus(peer)
    receive(other, lambda f: True)
    bus.send(message(0x7AB, [1, 2, 3]))
    assert receive(other, lambda f: f.arbitration_id == 0x7AB).data == b"\x01\x02\x03"
    other.shutdown()


@pytest.mark.wire
def test_the_version_is_answered(bus: can.BusABC, model: VehicleModel) -> None:
    bus.send(message(0x411, [1]))
    assert receive(bus, lambda f: f.arbitration_id == 0x41A).data == struct.pack(">4H", *model.params.versions)
    bus.send(message(0x4A1, [1]))
    text = b"".join(receive(bus, lambda f: f.arbitration_id == 0x4A1).data for _ in range(10))
    assert text.split() == [b"SIMULATED", b"HW2.1", b"CONTROLLER", b"204", b"DRIVERS", b"110"]


@pytest.mark.wire
def test_bus_off_ends_the_connection_and_it_can_be_opened_again(peer: AgilexPeer) -> None:
    bus = open_bus(peer)
    with pytest.raises(ValueError, match=r"can\.bus_off"):
        peer.fault("can.nonsense")
    # An adapter that was not accepted yet would not lose anything.
    receive(bus, lambda f: f.arbitration_id == 0x211)
    peer.fault("can.bus_off")
    with pytest.raises(can.CanError):
        receive(bus, lambda f: False)
    # Closing it says goodbye to an adapter that is no longer there.
    with contextlib.suppress(can.CanError):
        bus.shutdown()
    again = open_bus(peer)
    receive(again, lambda f: f.arbitration_id == 0x211)
    again.shutdown()


@pytest.mark.wire
def test_an_adapter_answers_as_the_lawicel_protocol_says(adapter: socket.socket, peer: AgilexPeer) -> None:
    assert ask(adapter, b"V") == b"V1013\r"
    assert ask(adapter, b"N") == b"NSIM1\r"
    assert ask(adapter, b"t1110") == b"\a"
    assert ask(adapter, b"S5") == b"\r"
    assert ask(adapter, b"O") == b"\r"
    assert ask(adapter, b"O") == b"\a"
    assert ask(adapter, b"t1110") == b"\a"
    assert ask(adapter, b"F") == b"F84\r"
    assert ask(adapter, b"C") == b"\r"
    assert ask(adapter, b"S6") == b"\r"
    for malformed in (b"t11", b"t8000", b"t1119", b"t1112AA", b"tXYZ0", b"S9", b"Q", b"\xff\xfe"):
        assert ask(adapter, malformed) == b"\a"


@pytest.mark.wire
def test_clients_that_die_or_do_not_read_do_not_disturb_the_others(peer: AgilexPeer, bus: can.BusABC) -> None:
    host, port = peer.channel.removeprefix("socket://").split(":")
    deaf = socket.create_connection((host, int(port)), timeout=2.0)
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    deaf.sendall(b"O\r" + b"\x00garbage" * 100)
    killed = socket.create_connection((host, int(port)), timeout=2.0)
    killed.sendall(b"O\rt1118")
    killed.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    killed.close()
    for _ in range(200):
        receive(bus, lambda f: f.arbitration_id == 0x221)
    deaf.close()


@pytest.mark.wire
def test_stopping_the_peer_leaves_no_thread(model: VehicleModel, clock: WorldClock) -> None:
    before = set(threading.enumerate())
    peer = AgilexPeer(model, clock)
    peer.start()
    with socket.create_connection(("127.0.0.1", int(peer.channel.rsplit(":", 1)[1])), timeout=2.0):
        peer.stop()
    assert set(threading.enumerate()) == before

"""The simulated rail: its physics against closed forms, its wire driven by the vendor's own client."""

from __future__ import annotations

import itertools
import socket
import struct
import threading
from collections.abc import Iterator

import numpy as np
import pytest
import serial
from pytrinamic.connections.serial_tmcl_interface import SerialTmclInterface
from pytrinamic.modules.TMCM1260 import TMCM1260
from pytrinamic.tmcl import TMCLReplyStatusError

from sim_backends.clock import WorldClock
from sim_backends.models import ramp
from sim_backends.models.rail import RailModel, RailParams, RailSettings
from sim_backends.models.ramp import Screw
from sim_backends.peers.rail.tmcl import TmclPeer
from tests.support.wire.clocks import until

STEPS = 200 * 256
LEAD = 0.002


def rail(seed: int = 1, **params: object) -> RailModel:
    return RailModel(RailParams(**params), np.random.default_rng(seed))  # type: ignore[arg-type]


def request(address: int, command: int, kind: int = 0, motor: int = 0, value: int = 0) -> bytes:
    body = struct.pack(">BBBBi", address, command, kind, motor, value)
    return body + bytes([sum(body) % 256])


# --- ramps ---


@pytest.mark.parametrize("x0, v0, target", [(0.0, 0.0, 10.0), (0.0, 3.0, 0.5), (2.0, -4.0, 8.0), (0.0, 6.0, 100.0)])
def test_a_ramp_arrives_at_rest_within_its_limits(x0: float, v0: float, target: float) -> None:
    pieces = ramp.to_position(5.0, x0, v0, target, 4.0, 2.0)
    times = np.linspace(5.0, pieces[-1].t + 1.0, 20001)
    states = np.array([next(p for p in reversed(pieces) if p.t <= t).at(t) for t in times])
    dt = times[1] - times[0]
    assert states[0] == pytest.approx([x0, v0])
    assert states[-1] == pytest.approx([target, 0.0], abs=1e-12)
    assert np.max(np.abs(np.diff(states[:, 1]))) <= 2.0 * dt * (1 + 1e-9)
    assert np.max(np.abs(states[:, 1])) <= max(4.0, abs(v0)) + 1e-9
    np.testing.assert_allclose(np.diff(states[:, 0]), 0.5 * dt * (states[1:, 1] + states[:-1, 1]), atol=1e-6)


@pytest.mark.parametrize("x0, v0, target", [(0.0, 0.0, 10.0), (0.0, 0.0, 0.3), (0.0, 3.0, 0.5), (2.0, -4.0, 8.0)])
def test_a_ramp_of_six_points_changes_speed_by_each_of_its_slopes(x0: float, v0: float, target: float) -> None:
    slopes = ramp.Slopes(up=2.0, down=1.0, first_speed=0.5, first_up=0.8, last_down=0.6)
    pieces = ramp.to_position(0.0, x0, v0, target, 4.0, slopes)
    assert pieces[-1].at(pieces[-1].t + 1.0) == pytest.approx((target, 0.0))
    for piece, after in itertools.pairwise(pieces):
        end = piece.at(after.t)
        assert end == pytest.approx((after.x, after.v), abs=1e-6), "no jump"
        if piece.a:
            faster = abs(end[1]) > abs(piece.v)
            below = max(abs(end[1]), abs(piece.v)) <= 0.5 + 1e-9
            wanted = (0.8 if below else 2.0) if faster else (0.6 if below else 1.0)
            assert abs(piece.a) == pytest.approx(wanted)


def test_a_move_takes_the_time_of_its_trapezoid() -> None:
    model = rail()
    model.set_position(0.0, 0)
    model.configure(0.0, RailSettings(max_velocity=5 * STEPS, max_acceleration=20 * STEPS))
    model.move_to(1.0, 10 * STEPS)
    arrival = 1.0 + 10.0 / 5.0 + 5.0 / 20.0
    assert not model.reached(arrival - 1e-3)
    assert model.reached(arrival + 1e-9)
    assert model.velocity(2.0) == 5 * STEPS
    start = model.carriage(1.0)
    assert model.carriage(2.0) - start == pytest.approx(LEAD * (5.0 * 0.875), abs=1e-12)
    assert model.carriage(9.0) - start == pytest.approx(10 * LEAD, abs=1e-12)


def test_a_stop_on_the_way_ends_the_motion_on_the_ramp_and_the_past_stays_as_it_was() -> None:
    model = rail()
    model.configure(0.0, RailSettings(max_velocity=5 * STEPS, max_acceleration=20 * STEPS))
    model.rotate(0.0, 5 * STEPS)
    before = model.carriage(1.5)
    model.rotate(2.0, 0)
    assert model.carriage(1.5) == before
    assert model.carriage(9.0) - model.carriage(2.0) == pytest.approx(LEAD * 5.0**2 / (2 * 20.0), abs=1e-12)


# --- the screw ---


def test_the_carriage_shows_lead_error_periodic_error_and_backlash() -> None:
    screw = Screw(scale_error=1e-3, periodic=4e-6, phase=0.7, backlash=12e-6)
    model = rail(screw=screw, start=0.0)

    def stands_at(t: float, turns: int) -> float:
        model.move_to(t, turns * STEPS)
        return model.carriage(t + 20.0)

    up_40, _, up_20 = stands_at(0.0, 40), stands_at(100.0, 0), stands_at(200.0, 20)
    _, down_20 = stands_at(300.0, 40), stands_at(400.0, 20)
    # Whole turns: the periodic error is the same everywhere, so only lead error and backlash are left.
    assert up_40 - up_20 == pytest.approx(20 * LEAD * 1.001, abs=1e-12)
    assert down_20 - up_20 == pytest.approx(12e-6 * 1.001, rel=0.02)
    model.rotate(500.0, -STEPS // 4)
    travel = np.array([model.carriage(t) for t in np.arange(502.0, 526.0, 0.004)])
    ideal = -LEAD * 1.001 * 0.25 * np.arange(len(travel)) * 0.004
    residual = travel - ideal - np.mean(travel - ideal)
    assert np.max(residual) == pytest.approx(4e-6, rel=0.01)
    assert np.min(residual) == pytest.approx(-4e-6, rel=0.01)


@pytest.mark.parametrize("travel", [-0.004, 0.0, 0.0501, 0.104])
def test_the_screw_is_inverted_exactly(travel: float) -> None:
    screw = Screw(scale_error=-2e-3, periodic=8e-6, phase=2.0)
    assert screw.travel(screw.nut(travel)) == pytest.approx(travel, abs=1e-15)


def test_searches_scatter_by_the_repeatability() -> None:
    model = rail(repeatability=5e-6)
    model.configure(0.0, RailSettings(search_mode=5))
    edges = []
    for i in range(400):
        model.search(20.0 * i)
        edges.append(model.carriage(20.0 * i + 19.0))
        assert model.position(20.0 * i + 19.0) == 0
    assert np.mean(edges) == pytest.approx(0.0, abs=1e-6)
    assert np.std(edges) == pytest.approx(5e-6, rel=0.15)


# --- the wire ---


@pytest.fixture
def clock() -> WorldClock:
    return WorldClock(20.0)


@pytest.fixture
def model() -> RailModel:
    return rail(serial=4711)


@pytest.fixture
def peer(model: RailModel, clock: WorldClock) -> Iterator[TmclPeer]:
    peer = TmclPeer(model, clock, pty=True)
    peer.start()
    yield peer
    peer.stop()


@pytest.fixture
def client(peer: TmclPeer) -> Iterator[SerialTmclInterface]:
    with SerialTmclInterface(peer.pty, timeout_s=2) as client:
        yield client


@pytest.fixture
def module(client: SerialTmclInterface) -> TMCM1260:
    return TMCM1260(client)


@pytest.fixture
def port(peer: TmclPeer) -> Iterator[serial.SerialBase]:
    with serial.serial_for_url(peer.url, timeout=2.0) as port:
        yield port


@pytest.mark.wire
def test_the_vendors_client_reads_version_and_serial_number(client: SerialTmclInterface, module: TMCM1260) -> None:
    assert client.get_version_string() == "1260V112"
    assert client.send(136, 1, 0, 0).value == 1260 << 16 | 1 << 8 | 12
    assert module.get_global_parameter(0, 2) == 4711
    assert module.get_global_parameter(module.GP0.SerialAddress, 0) == 1


@pytest.mark.wire
def test_the_vendors_client_homes_and_moves_the_rail(
    client: SerialTmclInterface, module: TMCM1260, model: RailModel, clock: WorldClock
) -> None:
    axis = module.motors[0]
    axis.set_axis_parameter(axis.AP.ReferenceSearchMode, 5)
    client.reference_search(0, 0)
    assert client.reference_search(2, 0) != 0
    until(clock, lambda: client.reference_search(2, 0) == 0)
    assert axis.actual_position == 0
    assert axis.get_axis_parameter(axis.AP.HomeSwitch) == 1
    assert model.carriage(clock.now()) == pytest.approx(0.0, abs=1e-9)
    module.move_to(0, 25 * STEPS, 10 * STEPS)
    assert axis.get_position_reached() == 0
    until(clock, axis.get_position_reached)
    assert (axis.actual_position, axis.target_position) == (25 * STEPS, 25 * STEPS)
    assert model.carriage(clock.now()) == pytest.approx(0.050, abs=1e-9)
    module.move_by(0, -5 * STEPS)
    until(clock, axis.get_position_reached)
    assert axis.actual_position == 20 * STEPS


@pytest.mark.wire
def test_the_ramp_has_the_names_of_the_vendors_library_and_is_none_until_it_is_set(
    module: TMCM1260, model: RailModel
) -> None:
    axis = module.motors[0]
    axis.linear_ramp.max_acceleration = 40 * STEPS
    assert axis.get_axis_parameter(axis.AP.MaxDeceleration) < 40 * STEPS
    for name, value in (("A1", 1000), ("V1", 2000), ("MaxDeceleration", 3000), ("D1", 4000)):
        axis.set_axis_parameter(getattr(axis.AP, name), value)
    found = model.settings
    ramp_of_module = (found.first_acceleration, found.first_speed, found.max_deceleration, found.last_deceleration)
    assert ramp_of_module == (1000, 2000, 3000, 4000)


@pytest.mark.wire
def test_the_switches_stop_the_motion_and_let_it_go_the_other_way(
    module: TMCM1260, model: RailModel, clock: WorldClock
) -> None:
    axis = module.motors[0]
    axis.linear_ramp.max_acceleration = 40 * STEPS
    module.rotate(0, 10 * STEPS)
    until(clock, lambda: axis.get_axis_parameter(axis.AP.RightEndstop))
    assert axis.actual_velocity == 0
    assert model.carriage(clock.now()) == pytest.approx(0.102, abs=1e-8)
    module.rotate(0, 10 * STEPS)
    clock.sleep(1.0)
    assert model.carriage(clock.now()) == pytest.approx(0.102, abs=1e-8)
    module.rotate(0, -10 * STEPS)
    until(clock, lambda: axis.get_axis_parameter(axis.AP.LeftEndstop))
    assert model.carriage(clock.now()) == pytest.approx(-0.002, abs=1e-8)


@pytest.mark.wire
def test_without_its_switches_the_rail_stalls_at_its_mechanical_end(
    module: TMCM1260, model: RailModel, clock: WorldClock
) -> None:
    axis = module.motors[0]
    axis.set_axis_parameter(axis.AP.LeftLimitSwitchDisable, 1)
    module.rotate(0, -10 * STEPS)
    until(clock, lambda: axis.get_axis_parameter(axis.AP.DrvStatusFlags) & 1)
    assert model.carriage(clock.now()) == pytest.approx(-0.004, abs=1e-8)
    assert axis.get_axis_parameter(axis.AP.ExtendedErrorFlags) == 1
    assert axis.get_axis_parameter(axis.AP.ExtendedErrorFlags) == 0


@pytest.mark.wire
def test_parameters_are_kept_and_range_checked(module: TMCM1260, client: SerialTmclInterface) -> None:
    axis = module.motors[0]
    for parameter, value in ((axis.AP.MaxCurrent, 200), (axis.AP.MicrostepResolution, 6), (axis.AP.MaxVelocity, 51200)):
        axis.set_axis_parameter(parameter, value)
        assert axis.get_axis_parameter(parameter) == value
    module.set_digital_output(1)
    assert (module.get_digital_output(0), module.get_digital_output(1)) == (0, 1)
    assert module.get_analog_input(8) == 240
    module.set_global_parameter(7, 2, -5)
    assert module.get_global_parameter(7, 2, signed=True) == -5
    refusals = [
        (lambda: axis.set_axis_parameter(axis.AP.MicrostepResolution, 9), 4),
        (lambda: axis.set_axis_parameter(axis.AP.ActualVelocity, 1), 3),
        (lambda: axis.get_axis_parameter(99), 3),
        (lambda: client.send(99, 0, 0, 0), 2),
        (lambda: client.get_axis_parameter(1, 1), 4),
        (lambda: client.send(13, 7, 0, 0), 3),
    ]
    for call, status in refusals:
        with pytest.raises(TMCLReplyStatusError) as refusal:
            call()
        assert refusal.value.status_code == status


@pytest.mark.wire
def test_a_locked_eeprom_refuses_to_store(module: TMCM1260) -> None:
    axis = module.motors[0]
    axis.set_axis_parameter(axis.AP.MaxCurrent, 77)
    module.store_axis_parameter(axis.AP.MaxCurrent, 0)
    axis.set_axis_parameter(axis.AP.MaxCurrent, 10)
    module.restore_axis_parameter(axis.AP.MaxCurrent, 0)
    assert axis.get_axis_parameter(axis.AP.MaxCurrent) == 77
    module.set_global_parameter(73, 0, 1234)
    with pytest.raises(TMCLReplyStatusError) as refusal:
        module.store_axis_parameter(axis.AP.MaxCurrent, 0)
    assert refusal.value.status_code == 5


@pytest.mark.wire
def test_a_wrong_checksum_is_answered_with_status_1(port: serial.SerialBase) -> None:
    port.write(request(1, 6, 1)[:-1] + b"\x00")
    assert port.read(9)[2] == 1


@pytest.mark.wire
def test_garbage_parts_and_foreign_addresses_do_no_harm(peer: TmclPeer, port: serial.SerialBase) -> None:
    port.write(b"\xff" * 5)
    WorldClock().sleep(0.2)
    port.write(request(7, 6, 1))
    port.write(request(1, 6, 4))
    reply = port.read(9)
    assert struct.unpack(">BBBBi", reply[:8]) == (2, 1, 100, 6, 512_000)
    assert sum(reply[:8]) % 256 == reply[8]


@pytest.mark.wire
def test_a_killed_client_leaves_the_rail_to_the_next_one(peer: TmclPeer) -> None:
    host, port = peer.url.removeprefix("socket://").split(":")
    killed = socket.create_connection((host, int(port)), timeout=2.0)
    killed.sendall(request(1, 6, 1) * 50 + b"\x01\x02")
    killed.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    killed.close()
    with serial.serial_for_url(peer.url, timeout=2.0) as again:
        again.write(request(1, 6, 202))
        assert struct.unpack(">i", again.read(9)[4:8]) == (200,)


@pytest.mark.wire
def test_a_dropped_reply_is_the_next_one_only(peer: TmclPeer, port: serial.SerialBase, model: RailModel) -> None:
    with pytest.raises(ValueError, match=r"rail\.drop_reply"):
        peer.fault("rail.nonsense")
    peer.fault("rail.drop_reply")
    port.timeout = 0.2
    port.write(request(1, 9, 3, 2, 123))
    assert port.read(9) == b""
    port.write(request(1, 10, 3, 2))
    assert struct.unpack(">i", port.read(9)[4:8]) == (123,)


@pytest.mark.wire
def test_a_reset_takes_what_is_not_in_the_eeprom(peer: TmclPeer, module: TMCM1260, model: RailModel) -> None:
    axis = module.motors[0]
    module.set_global_parameter(7, 2, 70)
    module.store_global_parameter(7, 2)
    module.set_global_parameter(8, 2, 80)
    module.set_global_parameter(200, 2, 90)
    with pytest.raises(TMCLReplyStatusError):
        module.store_global_parameter(200, 2)
    axis.set_axis_parameter(axis.AP.MaxVelocity, 51200)
    module.rotate(0, 10 * STEPS)
    WorldClock().sleep(0.1)
    peer.fault("rail.reset")
    stands = model.carriage(peer.module._clock.now())
    assert (axis.actual_position, axis.actual_velocity, axis.target_position) == (0, 0, 0)
    assert [module.get_global_parameter(number, 2) for number in (0, 7, 8, 200)] == [4711, 70, 0, 0]
    assert axis.get_axis_parameter(axis.AP.MaxVelocity) == 512_000
    assert model.carriage(peer.module._clock.now()) == stands


@pytest.mark.wire
def test_late_replies_are_late_until_the_faults_are_cleared(peer: TmclPeer, port: serial.SerialBase) -> None:
    def round_trip() -> float:
        clock = WorldClock()
        port.write(request(1, 6, 1))
        assert len(port.read(9)) == 9
        return clock.now()

    peer.fault("rail.late_reply")
    assert 0.2 < min(round_trip(), round_trip()) < 0.5
    peer.clear()
    # The shortest: whoever asks may not be run for a moment.
    assert min(round_trip() for _ in range(3)) < 0.15


@pytest.mark.wire
def test_stopping_the_peer_leaves_no_thread(model: RailModel, clock: WorldClock) -> None:
    before = set(threading.enumerate())
    peer = TmclPeer(model, clock, pty=True)
    peer.start()
    with socket.create_connection(("127.0.0.1", int(peer.url.rsplit(":", 1)[1])), timeout=2.0):
        peer.stop()
    assert set(threading.enumerate()) == before

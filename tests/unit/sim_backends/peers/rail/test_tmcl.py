"""The simulated stepper module at its wire, driven by the vendor's own client."""

import struct
from collections.abc import Iterator

import numpy as np
import pytest
import serial
from pytrinamic.connections.serial_tmcl_interface import SerialTmclInterface
from pytrinamic.modules.TMCM1260 import TMCM1260
from pytrinamic.tmcl import TMCLReplyStatusError

from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.tmcl import TmclPeer
from tests.support.wire.clocks import until

pytestmark = pytest.mark.wire
STEPS = 200 * 256


def request(address: int, command: int, kind: int = 0, motor: int = 0, value: int = 0) -> bytes:
    body = struct.pack(">BBBBi", address, command, kind, motor, value)
    return body + bytes([sum(body) % 256])


@pytest.fixture
def clock() -> WorldClock:
    return WorldClock(20.0)


@pytest.fixture
def model() -> RailModel:
    return RailModel(RailParams(serial=4711), np.random.default_rng(1))


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


def test_the_vendors_client_reads_version_and_serial_number(client: SerialTmclInterface, module: TMCM1260):
    assert client.get_version_string() == "1260V112"
    assert client.send(136, 1, 0, 0).value == 1260 << 16 | 1 << 8 | 12
    assert module.get_global_parameter(0, 2) == 4711
    assert module.get_global_parameter(module.GP0.SerialAddress, 0) == 1


def test_the_vendors_client_homes_and_moves_the_rail(
    client: SerialTmclInterface, module: TMCM1260, model: RailModel, clock: WorldClock
):
    axis = module.motors[0]
    axis.set_axis_parameter(axis.AP.ReferenceSearchMode, 5)
    client.reference_search(0, 0)
    assert client.reference_search(2, 0) != 0
    until(clock, lambda: client.reference_search(2, 0) == 0)
    assert (axis.actual_position, axis.get_axis_parameter(axis.AP.HomeSwitch)) == (0, 1)
    assert model.carriage(clock.now()) == pytest.approx(0.0, abs=1e-9)
    module.move_to(0, 25 * STEPS, 10 * STEPS)
    assert axis.get_position_reached() == 0
    until(clock, axis.get_position_reached)
    assert (axis.actual_position, axis.target_position) == (25 * STEPS, 25 * STEPS)
    assert model.carriage(clock.now()) == pytest.approx(0.050, abs=1e-9)
    module.move_by(0, -5 * STEPS)
    until(clock, axis.get_position_reached)
    assert axis.actual_position == 20 * STEPS


def test_the_ramp_has_the_names_of_the_vendors_library_and_is_none_until_it_is_set(module: TMCM1260, model: RailModel):
    axis = module.motors[0]
    axis.linear_ramp.max_acceleration = 40 * STEPS
    assert axis.get_axis_parameter(axis.AP.MaxDeceleration) < 40 * STEPS
    for name, value in (("A1", 1000), ("V1", 2000), ("MaxDeceleration", 3000), ("D1", 4000)):
        axis.set_axis_parameter(getattr(axis.AP, name), value)
    found = model.settings
    ramp_of_module = (found.first_acceleration, found.first_speed, found.max_deceleration, found.last_deceleration)
    assert ramp_of_module == (1000, 2000, 3000, 4000)


def test_parameters_are_kept_and_range_checked(module: TMCM1260, client: SerialTmclInterface):
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


def test_a_locked_eeprom_refuses_to_store(module: TMCM1260):
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


def test_garbage_parts_and_foreign_addresses_do_no_harm(peer: TmclPeer, port: serial.SerialBase):
    port.write(b"\xff" * 5)
    WorldClock().sleep(0.2)
    port.write(request(7, 6, 1))
    port.write(request(1, 6, 4))
    reply = port.read(9)
    assert struct.unpack(">BBBBi", reply[:8]) == (2, 1, 100, 6, 512_000)
    assert sum(reply[:8]) % 256 == reply[8]


def test_a_reset_takes_what_is_not_in_the_eeprom(peer: TmclPeer, module: TMCM1260, model: RailModel):
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
    stands = model.carriage(peer.module.clock.now())
    assert (axis.actual_position, axis.actual_velocity, axis.target_position) == (0, 0, 0)
    assert [module.get_global_parameter(number, 2) for number in (0, 7, 8, 200)] == [4711, 70, 0, 0]
    assert axis.get_axis_parameter(axis.AP.MaxVelocity) == 512_000
    assert model.carriage(peer.module.clock.now()) == stands

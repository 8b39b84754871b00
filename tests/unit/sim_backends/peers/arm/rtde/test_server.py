"""The simulated controller under the real ur_rtde: stops, outputs, time, clients that misbehave."""

import socket
import struct

import numpy as np
import pytest
from rtde_control import RTDEControlInterface

from tests.support.simulator.rtde_client import Rtde
from tests.support.simulator.ur_client import CLOCK, HOME, SPEED, Client, distance, flange, se3, until
from tests.support.wire.arm_bench import ArmBench

pytestmark = pytest.mark.wire


def test_the_world_runs_as_many_times_faster_as_asked_at_an_unchanged_packet_rate(arm: Client):
    wall, world = CLOCK.now(), arm.receive.getTimestamp()
    started = arm.receive.getTimestamp()
    assert arm.control.moveJ((HOME + 0.5).tolist(), 0.5, 2.0)
    # 0.5 rad at 0.5 rad/s with ramps of 0.25 s takes 1.25 s of the world; the handshake costs some wall milliseconds.
    assert arm.receive.getTimestamp() - started == pytest.approx(1.25, abs=0.05 * SPEED)
    until(lambda: arm.receive.getTimestamp() - world > 0.6 * SPEED)
    assert (arm.receive.getTimestamp() - world) / (CLOCK.now() - wall) == pytest.approx(SPEED, rel=0.03)


def test_clients_that_vanish_send_garbage_or_never_read_leave_the_others_alone(arm: Client):
    address = arm.simulator.address
    for port in (30004, 29999, 30003):
        for junk in (b"", b"\0", b"\0\0\0\0", b"\xff" * 70000, b"GET / HTTP/1.1\r\n\r\n", bytes(range(256))):
            connection = socket.create_connection((address, port), timeout=5.0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.send(junk)
            connection.close()
    deaf = Rtde(address)
    deaf.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    deaf.ask("O", struct.pack(">d", 500.0) + b"actual_q,actual_TCP_pose,")
    deaf.ask("S")
    assert arm.control.moveJ((HOME + 0.05).tolist(), 1.5, 5.0)
    until(lambda: bool(np.allclose(arm.q(), HOME + 0.05)))
    deaf.socket.close()


def test_two_arms_run_side_by_side_and_a_client_can_leave_and_come_back(arm: Client):
    with ArmBench() as other:
        assert other.address != arm.simulator.address and other.address.startswith("127.0.")
        for offset in (0.1, 0.2):
            control = RTDEControlInterface(other.address)
            assert distance(se3(control.getForwardKinematics()), flange(HOME + offset - 0.1)) < 1e-9
            assert control.moveJ((HOME + offset).tolist(), 1.5, 10.0)
            assert distance(se3(control.getForwardKinematics()), flange(HOME + offset)) < 1e-9
            del control
        np.testing.assert_allclose(arm.q(), HOME, atol=1e-9)


def test_inputs_of_ur_rtde_are_in_use_and_packets_are_padded_or_cut(arm: Client):
    client = Rtde(arm.simulator.address)
    assert struct.unpack(">4I", client.ask("v"))[:2] == (5, 15)
    reply = client.ask("I", b"input_int_register_47,standard_digital_output_mask")
    assert reply.endswith(b"INT32,IN_USE"), "ur_rtde's IO interface owns the outputs"
    names = b"input_double_register_46,input_double_register_47"
    assert client.ask("I", names + b",") == b"\1DOUBLE,DOUBLE"
    assert client.ask("O", struct.pack(">d", 125.0) + names) == b"\1DOUBLE,DOUBLE"
    client.ask("S")
    for body, values in ((struct.pack(">3d", 1.0, 2.0, 3.0), (1.0, 2.0)), (struct.pack(">d", 4.0), (4.0, 0.0))):
        client.notify(b"\1" + body)
        client.ask("v")
        assert struct.unpack(">B2d", client.states(2)[-1]) == (1, *values)
    client.socket.close()

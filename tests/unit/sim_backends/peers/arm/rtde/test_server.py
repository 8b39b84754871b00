"""The simulated controller under the real ur_rtde: stops, outputs, time, clients that misbehave."""

from __future__ import annotations

import socket
import struct

import numpy as np
import pytest
from dashboard_client import DashboardClient
from rtde_control import RTDEControlInterface

from tests.support.simulator.rtde_client import Rtde
from tests.support.simulator.ur_client import CLOCK, HOME, SPEED, Client, dashboard, distance, flange, se3, until
from tests.support.wire.arm_bench import ArmBench

pytestmark = pytest.mark.wire


def test_digital_outputs_of_all_three_kinds_and_inputs_are_seen(arm: Client) -> None:
    started = CLOCK.now()
    for switch, bit in (
        (lambda level: arm.io.setStandardDigitalOut(0, level), 0),
        (lambda level: arm.io.setStandardDigitalOut(7, level), 7),
        (lambda level: arm.io.setConfigurableDigitalOut(1, level), 9),
        (lambda level: arm.io.setToolDigitalOut(1, level), 17),
    ):
        others = arm.receive.getActualDigitalOutputBits() & ~(1 << bit)
        for level in (True, False):
            assert switch(level)
            until(lambda: bool(arm.receive.getActualDigitalOutputBits() >> bit & 1) == level)  # noqa: B023
            assert arm.receive.getActualDigitalOutputBits() & ~(1 << bit) == others
    # Eight writes that each wait for their echo: a delayed acknowledgement would cost 40 ms every time.
    assert CLOCK.now() - started < 8 * 0.04
    arm.simulator.ask("input 0 1")
    until(lambda: arm.receive.getActualDigitalInputBits() == 1)
    arm.simulator.ask("input 0 0")
    until(lambda: arm.receive.getActualDigitalInputBits() == 0)


def test_a_protective_stop_is_seen_refuses_moves_and_is_left_through_the_dashboard(arm: Client) -> None:
    assert arm.control.moveJ((HOME + 1.0).tolist(), 0.2, 5.0, True)
    until(lambda: arm.q()[0] > 0.02)
    arm.simulator.ask("protective_stop")
    until(lambda: bool(arm.receive.isProtectiveStopped()))
    assert arm.receive.getSafetyMode() == 3
    assert arm.receive.getSafetyStatusBits() >> 10 & 1
    until(lambda: not arm.control.isProgramRunning())
    assert not arm.control.moveJ(HOME.tolist(), 1.0, 1.0)
    assert dashboard(arm.simulator.address, "safetystatus") == ["Safetystatus: PROTECTIVE_STOP"]
    client = DashboardClient(arm.simulator.address)
    client.connect()
    with pytest.raises(RuntimeError, match="5s"):
        client.unlockProtectiveStop()
    until(lambda: dashboard(arm.simulator.address, "unlock protective stop") == ["Protective stop releasing"])
    until(lambda: not arm.receive.isProtectiveStopped())
    stopped_at = arm.q()
    assert arm.control.reuploadScript()
    until(lambda: bool(arm.control.isProgramRunning()))
    np.testing.assert_array_equal(arm.q(), stopped_at)
    assert arm.control.moveJ(HOME.tolist(), 1.5, 5.0)
    until(lambda: bool(np.allclose(arm.q(), HOME)))


def test_playing_after_a_protective_stop_finishes_the_old_move(arm: Client) -> None:
    target = HOME + 0.3
    assert arm.control.moveJ(target.tolist(), 0.5, 5.0, True)
    until(lambda: arm.q()[0] > 0.02)
    arm.control.triggerProtectiveStop()
    until(lambda: bool(arm.receive.isProtectiveStopped()))
    until(lambda: dashboard(arm.simulator.address, "unlock protective stop") == ["Protective stop releasing"])
    assert dashboard(arm.simulator.address, "play") == ["Starting program"]
    until(lambda: bool(np.allclose(arm.q(), target)))


def test_an_emergency_stop_switches_off_until_the_arm_is_powered_again(arm: Client) -> None:
    assert arm.control.moveJ((HOME + 1.0).tolist(), 0.2, 5.0, True)
    until(lambda: arm.q()[0] > 0.02)
    arm.simulator.ask("emergency_stop")
    until(lambda: bool(arm.receive.isEmergencyStopped()))
    until(lambda: arm.receive.getRobotMode() == 3)
    assert (arm.receive.getSafetyMode(), arm.receive.getRuntimeState()) == (7, 1)
    assert arm.receive.getRobotStatus() & 3 == 0
    assert not arm.control.moveJ(HOME.tolist(), 1.0, 1.0)
    assert dashboard(arm.simulator.address, "brake release", "robotmode")[1] == "Robotmode: POWER_OFF"
    arm.simulator.ask("clear")
    until(lambda: not arm.receive.isEmergencyStopped())
    assert dashboard(arm.simulator.address, "power on", "robotmode", "brake release", "robotmode") == [
        "Powering on",
        "Robotmode: IDLE",
        "Brake releasing",
        "Robotmode: RUNNING",
    ]
    assert arm.control.reuploadScript()
    until(lambda: bool(arm.control.isProgramRunning()))
    assert arm.control.moveJ(HOME.tolist(), 1.5, 5.0)


def test_the_world_runs_as_many_times_faster_as_asked_at_an_unchanged_packet_rate(arm: Client) -> None:
    wall, world = CLOCK.now(), arm.receive.getTimestamp()
    started = arm.receive.getTimestamp()
    assert arm.control.moveJ((HOME + 0.5).tolist(), 0.5, 2.0)
    # 0.5 rad at 0.5 rad/s with ramps of 0.25 s takes 1.25 s of the world; the handshake costs some wall milliseconds.
    assert arm.receive.getTimestamp() - started == pytest.approx(1.25, abs=0.05 * SPEED)
    until(lambda: arm.receive.getTimestamp() - world > 0.6 * SPEED)
    assert (arm.receive.getTimestamp() - world) / (CLOCK.now() - wall) == pytest.approx(SPEED, rel=0.03)


def test_a_second_control_interface_is_refused(arm: Client) -> None:
    with pytest.raises(RuntimeError, match="already in use"):
        RTDEControlInterface(arm.simulator.address)
    assert arm.control.moveJ((HOME + 0.05).tolist(), 1.5, 5.0)


def test_clients_that_vanish_send_garbage_or_never_read_leave_the_others_alone(arm: Client) -> None:
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


def test_two_arms_run_side_by_side_and_a_client_can_leave_and_come_back(arm: Client) -> None:
    with ArmBench() as other:
        assert other.address != arm.simulator.address and other.address.startswith("127.0.")
        for offset in (0.1, 0.2):
            control = RTDEControlInterface(other.address)
            assert distance(se3(control.getForwardKinematics()), flange(HOME + offset - 0.1)) < 1e-9
            assert control.moveJ((HOME + offset).tolist(), 1.5, 10.0)
            assert distance(se3(control.getForwardKinematics()), flange(HOME + offset)) < 1e-9
            del control
        np.testing.assert_allclose(arm.q(), HOME, atol=1e-9)


def test_inputs_of_ur_rtde_are_in_use_and_packets_are_padded_or_cut(arm: Client) -> None:
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

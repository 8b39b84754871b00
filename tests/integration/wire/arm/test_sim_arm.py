"""The simulated arm at its wire, talked to by the real ur_rtde.

The simulator runs in a process of its own, since ur_rtde's constructors hold the interpreter's lock, and outlives every
control interface, since ur_rtde does not survive the loss of its link.
"""

from __future__ import annotations

import json
import math
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pinocchio as pin
import pytest
from dashboard_client import DashboardClient
from numpy.typing import NDArray
from rtde_control import Path as MovePath
from rtde_control import PathEntry, RTDEControlInterface
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface

from drivers.clock import Clock
from tests.support import ROOT

pytestmark = pytest.mark.wire

SPEED = 5.0
CLOCK = Clock()
DH = [
    (0.0, 0.1807, math.pi / 2),
    (-0.6127, 0.0, 0.0),
    (-0.57155, 0.0, 0.0),
    (0.0, 0.17415, math.pi / 2),
    (0.0, 0.11985, -math.pi / 2),
    (0.0, 0.11655, 0.0),
]
"""a, d, alpha of the UR10e as the maker publishes them."""


def flange(q: NDArray[np.float64] | list[float]) -> pin.SE3:
    pose = pin.SE3.Identity()
    for (a, d, alpha), angle in zip(DH, q, strict=True):
        pose = pose * pin.SE3(pin.utils.rotate("z", angle), np.zeros(3))
        pose = pose * pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, d]))
    return pose


def se3(pose: list[float]) -> pin.SE3:
    return pin.SE3(pin.exp3(np.array(pose[3:])), np.array(pose[:3]))


def distance(a: pin.SE3, b: pin.SE3) -> float:
    return float(np.linalg.norm(pin.log6(a.actInv(b)).vector))


def until(condition: Callable[[], bool], timeout: float = 5.0) -> None:
    deadline = CLOCK.now() + timeout
    while not condition():
        assert CLOCK.now() < deadline, "it did not happen in time"
        CLOCK.sleep(0.004)


class SimulatedArm:
    """A simulated arm in a process of its own; standard input brings about faults."""

    def __init__(self, *options: str) -> None:
        command = [sys.executable, "-m", "sim_backends.peers.arm.rtde.server", "--json", "--until-eof", *options]
        self._process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        self.address: str = self._answer()["address"]

    def tell(self, command: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        assert self._answer()["ok"]

    def end(self) -> int:
        assert self._process.stdin is not None
        self._process.stdin.close()
        return self._process.wait(10.0)

    def _answer(self) -> dict[str, object]:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())


class Client:
    """ur_rtde's three interfaces to one arm."""

    def __init__(self, simulator: SimulatedArm) -> None:
        self.simulator = simulator
        self.receive = RTDEReceiveInterface(simulator.address)
        self.control = RTDEControlInterface(simulator.address)
        self.io = RTDEIOInterface(simulator.address)

    def q(self) -> NDArray[np.float64]:
        return np.array(self.receive.getActualQ())

    def recover(self) -> None:
        """Everything as after the start: safety normal, program running, arm at home."""
        self.simulator.tell("clear")
        for command in ("power on", "brake release"):
            dashboard(self.simulator.address, command)
        until(lambda: self.receive.getRobotMode() == 7)
        self.control.reuploadScript()
        until(lambda: bool(self.control.isProgramRunning()))
        assert self.control.moveJ(HOME.tolist(), 2.0, 20.0)
        assert self.control.setTcp([0.0] * 6)


HOME = np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])


def dashboard(address: str, *commands: str) -> list[str]:
    with socket.create_connection((address, 29999), timeout=5.0) as connection:
        lines = connection.makefile("r")
        answers = [lines.readline().strip()]
        for command in commands:
            connection.sendall(command.encode() + b"\n")
            answers.append(lines.readline().strip())
    return answers[1:] if commands else answers


@pytest.fixture(scope="module")
def session() -> Iterator[Client]:
    simulator = SimulatedArm("--speed", str(SPEED))
    client = Client(simulator)
    yield client
    client.control.stopScript()
    client.control.disconnect()
    client.io.disconnect()
    client.receive.disconnect()
    assert simulator.end() == 0


@pytest.fixture
def arm(session: Client) -> Iterator[Client]:
    session.recover()
    return session


def test_a_joint_move_arrives_and_the_reported_pose_is_that_of_the_joints(arm: Client) -> None:
    target = HOME + np.array([0.3, -0.2, 0.1, 0.2, -0.1, 0.4])
    assert arm.control.moveJ(target.tolist(), 1.5, 5.0)
    until(lambda: bool(np.allclose(arm.q(), target, atol=1e-9)))
    assert distance(flange(target), se3(arm.receive.getActualTCPPose())) < 1e-9
    until(lambda: bool(arm.control.isSteady()))


def test_a_linear_move_arrives(arm: Client) -> None:
    target = arm.receive.getActualTCPPose()
    target[0] -= 0.05
    target[2] += 0.08
    assert arm.control.moveL(target, 0.5, 2.0)
    until(lambda: distance(se3(target), se3(arm.receive.getActualTCPPose())) < 1e-8)
    assert distance(flange(arm.q()), se3(target)) < 1e-8


def test_moves_to_a_pose_and_along_a_line_to_joints(arm: Client) -> None:
    goal = flange(HOME + 0.1)
    pose = [*goal.translation, *pin.log3(goal.rotation)]
    assert arm.control.moveJ_IK(pose, 1.5, 5.0)
    until(lambda: distance(goal, se3(arm.receive.getActualTCPPose())) < 1e-7)
    assert arm.control.moveL_FK(HOME.tolist(), 0.5, 2.0)
    until(lambda: distance(flange(HOME), se3(arm.receive.getActualTCPPose())) < 1e-7)


def test_an_asynchronous_move_shows_progress_and_can_be_stopped(arm: Client) -> None:
    target = HOME + np.array([1.0, 0, 0, 0, 0, 0])
    before = arm.control.getAsyncOperationProgressEx().operationId()
    assert arm.control.moveJ(target.tolist(), 0.5, 5.0, True)
    until(lambda: bool(arm.control.getAsyncOperationProgressEx().isAsyncOperationRunning()))
    assert arm.control.getAsyncOperationProgressEx().operationId() == (before + 1) % 128
    assert arm.control.getAsyncOperationProgress() >= 0
    until(lambda: arm.q()[0] > 0.1)
    arm.control.stopJ(10.0)
    assert not arm.control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    assert arm.control.getAsyncOperationProgress() < 0
    until(lambda: not any(arm.receive.getActualQd()))
    assert 0.1 < arm.q()[0] < 0.95
    assert arm.control.moveJ(HOME.tolist(), 1.0, 5.0, True)
    until(lambda: arm.control.getAsyncOperationProgress() < 0)
    until(lambda: bool(np.allclose(arm.q(), HOME)))


def test_a_streamed_joint_trajectory_is_tracked_with_a_small_lag(arm: Client) -> None:
    lag, gain, period = 0.05, 300.0, 0.002
    behind = []
    begun = CLOCK.now()
    for k in range(400):
        phase = 0.5 * math.pi * k * period * SPEED
        target = HOME + 0.1 * (1 - math.cos(phase))
        assert arm.control.servoJ(target.tolist(), 0.0, 0.0, period, lag, gain)
        if math.sin(phase) > 0.5:
            behind.append((target - arm.q()).mean() / (0.1 * 0.5 * math.pi * math.sin(phase)))
        CLOCK.sleep(begun + (k + 1) * period - CLOCK.now())
    # The lag and a few packets' age. The median: a moment in which this process was not run is no lag of the arm.
    assert 0.3 * lag < np.median(behind) < lag + 0.02 * SPEED
    until(lambda: bool(np.abs(target - arm.q()).max() < 0.001))
    assert arm.control.servoStop(10.0)
    assert arm.control.moveJ(HOME.tolist(), 1.5, 5.0), "the arm must obey moves again after the stream"


def test_a_move_during_a_stream_ends_the_program_as_on_the_controller(arm: Client) -> None:
    arm.control.servoJ(HOME.tolist(), 0.0, 0.0, 0.002, 0.1, 300.0)
    assert not arm.control.moveJ(HOME.tolist(), 1.0, 1.0)
    assert not arm.control.isProgramRunning()


def test_speed_commands_and_jogging(arm: Client) -> None:
    assert arm.control.speedJ([0, 0, 0, 0, 0, 0.5], 5.0)
    until(lambda: arm.q()[5] > 0.2)
    assert arm.receive.getActualQd()[5] == pytest.approx(0.5)
    assert arm.control.speedStop(10.0)
    height = arm.receive.getActualTCPPose()[2]
    assert arm.control.speedL([0, 0, 0.1, 0, 0, 0], 2.0)
    until(lambda: arm.receive.getActualTCPPose()[2] > height + 0.03)
    assert arm.receive.getActualTCPSpeed()[2] == pytest.approx(0.1, abs=1e-3)
    assert arm.control.speedStop(10.0)
    depth = arm.receive.getActualTCPPose()[2]
    assert arm.control.jogStart([0, 0, 0.1, 0, 0, 0], RTDEControlInterface.FEATURE_TOOL)
    until(lambda: arm.receive.getActualTCPPose()[2] < depth - 0.02)
    assert arm.control.jogStop()
    until(lambda: not any(arm.receive.getActualQd()))


def test_a_path_of_way_points_is_followed(arm: Client) -> None:
    path = MovePath()
    for offset in (0.1, 0.2):
        entry = [*(HOME + offset), 1.5, 5.0, 0.0]
        path.addEntry(PathEntry(PathEntry.MoveJ, PathEntry.PositionJoints, entry))
    assert arm.control.movePath(path, False)
    until(lambda: bool(np.allclose(arm.q(), HOME + 0.2)))


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
    arm.simulator.tell("input 0 1")
    until(lambda: arm.receive.getActualDigitalInputBits() == 1)
    arm.simulator.tell("input 0 0")
    until(lambda: arm.receive.getActualDigitalInputBits() == 0)


def test_kinematics_answers_agree_with_an_independent_chain(arm: Client) -> None:
    q = HOME + np.array([0.1, 0.2, -0.1, 0.3, 0.2, -0.4])
    assert distance(se3(arm.control.getForwardKinematics(q.tolist(), [0.0] * 6)), flange(q)) < 1e-9
    tool = [0.01, 0.02, 0.1, 0.1, 0.0, 0.2]
    assert distance(se3(arm.control.getForwardKinematics(q.tolist(), tool)), flange(q) * se3(tool)) < 1e-9
    goal = flange(q)
    pose = [*goal.translation, *pin.log3(goal.rotation)]
    np.testing.assert_allclose(arm.control.getInverseKinematics(pose, q.tolist()), q, atol=1e-7)
    assert distance(flange(arm.control.getInverseKinematics(pose)), goal) < 1e-7
    assert arm.control.getInverseKinematicsHasSolution(pose)
    assert not arm.control.getInverseKinematicsHasSolution([2.0, 0, 0, 0, 0, 0])
    assert distance(se3(arm.control.poseTrans(pose, tool)), goal * se3(tool)) < 1e-9
    assert arm.control.isJointsWithinSafetyLimits(q.tolist())
    assert not arm.control.isJointsWithinSafetyLimits([7.0, 0, 0, 0, 0, 0])
    assert arm.control.isPoseWithinSafetyLimits(pose)


def test_a_pose_out_of_reach_ends_the_program_and_the_call_says_so(arm: Client) -> None:
    assert arm.control.getInverseKinematics([2.0, 0, 0, 0, 0, 0]) == []
    assert not arm.control.isProgramRunning()
    assert not arm.control.moveJ(HOME.tolist(), 1.0, 1.0)


def test_tool_and_payload_are_taken(arm: Client) -> None:
    tool = [0.01, -0.02, 0.15, 0.0, 0.0, 0.3]
    assert arm.control.setTcp(tool)
    until(lambda: distance(se3(arm.receive.getActualTCPPose()), flange(HOME) * se3(tool)) < 1e-9)
    np.testing.assert_allclose(arm.control.getTCPOffset(), tool, atol=1e-12)
    target = arm.receive.getActualTCPPose()
    target[5] += 0.1
    assert arm.control.moveL(target, 0.5, 2.0)
    until(lambda: distance(se3(arm.receive.getActualTCPPose()), se3(target)) < 1e-8)
    assert arm.control.setPayload(3.5, [0.0, 0.01, 0.05])
    until(lambda: arm.receive.getPayload() == pytest.approx(3.5))
    np.testing.assert_allclose(arm.receive.getPayloadCog(), [0.0, 0.01, 0.05])
    assert arm.control.zeroFtSensor()


def test_a_protective_stop_is_seen_refuses_moves_and_is_left_through_the_dashboard(arm: Client) -> None:
    assert arm.control.moveJ((HOME + 1.0).tolist(), 0.2, 5.0, True)
    until(lambda: arm.q()[0] > 0.02)
    arm.simulator.tell("protective_stop")
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
    arm.simulator.tell("emergency_stop")
    until(lambda: bool(arm.receive.isEmergencyStopped()))
    until(lambda: arm.receive.getRobotMode() == 3)
    assert arm.receive.getSafetyMode() == 7
    assert arm.receive.getRuntimeState() == 1
    assert arm.receive.getRobotStatus() & 3 == 0
    assert not arm.control.moveJ(HOME.tolist(), 1.0, 1.0)
    assert dashboard(arm.simulator.address, "brake release", "robotmode")[1] == "Robotmode: POWER_OFF"
    arm.simulator.tell("clear")
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


def test_a_watchdog_that_is_not_kicked_stops_the_program(arm: Client) -> None:
    assert arm.control.setWatchdog(10.0)
    for _ in range(5):
        CLOCK.sleep(0.05)
        assert arm.control.kickWatchdog()
    assert arm.control.isProgramRunning()
    until(lambda: not arm.control.isProgramRunning(), timeout=1.0)


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


def packet(kind: str, payload: bytes = b"") -> bytes:
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


def answer(connection: socket.socket) -> tuple[str, bytes]:
    header = connection.recv(3, socket.MSG_WAITALL)
    size, kind = struct.unpack(">HB", header)
    return chr(kind), connection.recv(size - 3, socket.MSG_WAITALL)


def test_clients_that_vanish_send_garbage_or_never_read_leave_the_others_alone(arm: Client) -> None:
    address = arm.simulator.address
    for port in (30004, 29999, 30003):
        for junk in (b"", b"\0", b"\0\0\0\0", b"\xff" * 70000, b"GET / HTTP/1.1\r\n\r\n", bytes(range(256))):
            connection = socket.create_connection((address, port), timeout=5.0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.send(junk)
            connection.close()
    deaf = socket.create_connection((address, 30004), timeout=5.0)
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    deaf.sendall(packet("O", struct.pack(">d", 500.0) + b"actual_q,actual_TCP_pose,") + packet("S"))
    assert arm.control.moveJ((HOME + 0.05).tolist(), 1.5, 5.0)
    until(lambda: bool(np.allclose(arm.q(), HOME + 0.05)))
    deaf.close()


def test_the_protocol_tells_unknown_variables_apart_and_pads_or_cuts_packets(arm: Client) -> None:
    with socket.create_connection((arm.simulator.address, 30004), timeout=5.0) as connection:
        connection.sendall(packet("V", b"\0\2"))
        assert answer(connection) == ("V", b"\1")
        connection.sendall(packet("v"))
        major, minor, _, _ = struct.unpack(">4I", answer(connection)[1])
        assert (major, minor) == (5, 15)
        connection.sendall(packet("O", struct.pack(">d", 500.0) + b"timestamp,no_such_thing,"))
        assert answer(connection) == ("O", b"\0DOUBLE,NOT_FOUND")
        connection.sendall(packet("I", b"input_int_register_47,standard_digital_output_mask"))
        assert answer(connection)[1].endswith(b"INT32,IN_USE"), "ur_rtde's IO interface owns the outputs"
        connection.sendall(packet("I", b"input_double_register_46,input_double_register_47,"))
        assert answer(connection) == ("I", b"\1DOUBLE,DOUBLE")
        wanted = b"input_double_register_46,input_double_register_47"
        connection.sendall(packet("O", struct.pack(">d", 125.0) + wanted))
        assert answer(connection) == ("O", b"\1DOUBLE,DOUBLE")
        for body, values in ((struct.pack(">3d", 1.0, 2.0, 3.0), (1.0, 2.0)), (struct.pack(">d", 4.0), (4.0, 0.0))):
            connection.sendall(packet("U", b"\1" + body) + packet("S"))
            assert answer(connection) == ("S", b"\1")
            assert struct.unpack(">B2d", answer(connection)[1]) == (1, *values)
            connection.sendall(packet("P"))
            while (reply := answer(connection))[0] == "U":
                assert struct.unpack(">B2d", reply[1]) == (1, *values)
            assert reply == ("P", b"\1")


def test_the_dashboard_identifies_the_arm(arm: Client) -> None:
    banner = dashboard(arm.simulator.address)
    assert banner == ["Connected: Universal Robots Dashboard Server"]
    version, serial, model, remote, mode, safety, running, odd = dashboard(
        arm.simulator.address,
        "PolyscopeVersion",
        "get serial number",
        "get robot model",
        "is in remote control",
        "robotmode",
        "safetymode",
        "running",
        "make coffee",
    )
    assert version.startswith("URSoftware 5.15.")
    assert serial.isdigit()
    assert model == "UR10e"
    assert (remote, mode, safety) == ("true", "Robotmode: RUNNING", "Safetymode: NORMAL")
    assert running == "Program running: true"
    assert odd.startswith("could not understand")


def test_two_arms_run_side_by_side_and_a_client_can_leave_and_come_back(arm: Client) -> None:
    other = SimulatedArm()
    try:
        assert other.address != arm.simulator.address
        assert other.address.startswith("127.0.")
        for offset in (0.1, 0.2):
            control = RTDEControlInterface(other.address)
            assert distance(se3(control.getForwardKinematics()), flange(HOME + offset - 0.1)) < 1e-9
            assert control.moveJ((HOME + offset).tolist(), 1.5, 10.0)
            assert distance(se3(control.getForwardKinematics()), flange(HOME + offset)) < 1e-9
            del control
        np.testing.assert_allclose(arm.q(), HOME, atol=1e-9)
    finally:
        assert other.end() == 0

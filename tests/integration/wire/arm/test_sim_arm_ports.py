"""The simulated controller's ports for clients that are not ours: RTDE to the byte, script ports, dashboard."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice, pairwise

import pytest

from tests.support.wire.arm_bench import ArmBench

pytestmark = pytest.mark.wire


class Rtde:
    """One RTDE connection of a client that knows nothing of the simulated arm's code."""

    def __init__(self, address: str, version: int = 2) -> None:
        self.socket = socket.create_connection((address, 30004), timeout=5.0)
        self._rest = b""
        if version == 2:
            assert self.ask("V", struct.pack(">H", 2)) == b"\1"

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """Send one package; the reply of the same kind."""
        self.socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)
        while True:
            found, content = self.next()
            if found == kind:
                return content

    def tell(self, payload: bytes) -> None:
        self.socket.sendall(struct.pack(">HB", 3 + len(payload), ord("U")) + payload)

    def next(self) -> tuple[str, bytes]:
        while len(self._rest) < 3 or len(self._rest) < struct.unpack_from(">H", self._rest)[0]:
            data = self.socket.recv(65536)
            assert data, "the controller closed the connection"
            self._rest += data
        size, kind = struct.unpack_from(">HB", self._rest)
        content, self._rest = self._rest[3:size], self._rest[size:]
        return chr(kind), content

    def states(self, count: int) -> list[bytes]:
        found: list[bytes] = []
        while len(found) < count:
            kind, content = self.next()
            if kind == "U":
                found.append(content)
        return found


@pytest.fixture(scope="module")
def running() -> Iterator[ArmBench]:
    with ArmBench() as bench:
        yield bench


@pytest.fixture
def address(running: ArmBench) -> str:
    running.ask("clear")
    running.ask("reset")
    return str(running.address)


def dashboard(address: str, *commands: str) -> list[str]:
    with socket.create_connection((address, 29999), timeout=5.0) as connection:
        lines = connection.makefile("rw", newline="\n")
        assert lines.readline() == "Connected: Universal Robots Dashboard Server\n"
        answers = []
        for command in commands:
            lines.write(command + "\n")
            lines.flush()
            answers.append(lines.readline().rstrip("\n"))
        return answers


NUMBERED = ("int_register", "double_register")
NAMES = [
    "timestamp", "target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd",
    "actual_current", "joint_control_output", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force",
    "target_TCP_pose", "target_TCP_speed", "actual_digital_input_bits", "joint_temperatures", "actual_execution_time",
    "robot_mode", "joint_mode", "safety_status", "actual_tool_accelerometer", "speed_scaling", "target_speed_fraction",
    "actual_momentum", "actual_main_voltage", "actual_robot_voltage", "actual_robot_current", "actual_joint_voltage",
    "actual_digital_output_bits", "runtime_state", "joint_position_deviation_ratio", "payload", "payload_cog",
    "payload_inertia", "ft_raw_wrench", "script_control_line", "actual_current_window", "elbow_position",
    "elbow_velocity", "robot_status_bits", "safety_status_bits", "safety_mode", "io_current", "tool_mode",
    "tcp_force_scalar", "tcp_offset", "analog_io_types", "standard_analog_input0", "standard_analog_input1",
    "standard_analog_output0", "standard_analog_output1", "tool_analog_input_types", "tool_analog_input0",
    "tool_analog_input1", "tool_output_voltage", "tool_output_current", "tool_temperature", "tool_output_mode",
    "tool_digital_output0_mode", "tool_digital_output1_mode", "euromap67_input_bits", "euromap67_output_bits",
    "euromap67_24V_voltage", "euromap67_24V_current", "actual_configurable_digital_input_bits",
    "actual_configurable_digital_output_bits", "encoder0_raw", "encoder1_raw",
    *(f"{way}_bit_registers{bits}" for way in ("input", "output") for bits in ("0_to_31", "32_to_63")),
    *(f"{way}_bit_register_{i}" for way in ("input", "output") for i in range(64, 128)),
    *(f"{way}_{kind}_{i}" for way in ("input", "output") for kind in NUMBERED for i in range(48)),
]  # fmt: skip
"""The 393 outputs that the maker's own recording example can ask for."""
SIZES = {
    "BOOL": 1, "UINT8": 1, "UINT32": 4, "UINT64": 8, "INT32": 4, "DOUBLE": 8, "VECTOR3D": 24, "VECTOR6D": 48,
    "VECTOR6INT32": 24,
}  # fmt: skip


def test_every_documented_output_is_sent_with_its_type(address: str) -> None:
    assert len(NAMES) == 393
    client = Rtde(address)
    reply = client.ask("O", struct.pack(">d", 500.0) + ",".join(NAMES).encode())
    kinds = reply[1:].decode().split(",")
    assert reply[0] == 1
    types = dict(zip(NAMES, kinds, strict=True))
    assert (types["tool_output_mode"], types["tool_mode"], types["tool_output_voltage"]) == ("UINT8", "UINT32", "INT32")
    assert (types["joint_mode"], types["output_bit_register_64"]) == ("VECTOR6INT32", "BOOL")
    client.ask("S")
    (state,) = client.states(1)
    assert len(state) == 1 + sum(SIZES[kind] for kind in kinds)


def test_an_unknown_name_is_not_found_and_an_input_that_another_writes_is_in_use_until_it_leaves(address: str) -> None:
    first, second = Rtde(address), Rtde(address)
    assert first.ask("O", struct.pack(">d", 125.0) + b"timestamp,joint_gossip") == b"\0DOUBLE,NOT_FOUND"
    assert first.ask("I", b"input_bit_register_64,input_bit_registers0_to_31") == b"\1BOOL,UINT32"
    assert second.ask("I", b"input_int_register_5,input_bit_register_64,nonsense") == b"\0INT32,IN_USE,NOT_FOUND"
    first.socket.close()
    for _ in range(100):
        if second.ask("I", b"input_bit_register_64") == b"\1BOOL":
            return
    raise AssertionError("the input was not given back")


def test_inputs_of_every_kind_come_back_as_outputs(address: str) -> None:
    client = Rtde(address)
    names = "input_bit_registers0_to_31,input_bit_register_70,input_int_register_40,input_double_register_41"
    assert client.ask("I", names.encode()) == b"\1UINT32,BOOL,INT32,DOUBLE"
    client.tell(struct.pack(">BI?id", 1, 0x80000005, True, -7, 2.5))
    client.ask("O", struct.pack(">d", 500.0) + names.encode())
    client.ask("S")
    assert struct.unpack(">BI?id", client.states(4)[-1]) == (1, 0x80000005, True, -7, 2.5)


def test_receivers_have_rates_of_their_own_and_version_1_has_no_recipe_numbers(address: str) -> None:
    fast, slow, old = Rtde(address), Rtde(address), Rtde(address, version=1)
    fast.ask("O", struct.pack(">d", 500.0) + b"timestamp")
    slow.ask("O", struct.pack(">d", 25.0) + b"timestamp,actual_q")
    assert old.ask("O", b"timestamp,robot_mode") == b"DOUBLE,INT32"
    for client, steps, code in ((fast, 0.002, ">Bd"), (slow, 0.04, ">Bd6d"), (old, 0.002, ">di")):
        client.ask("S")
        stamps = [struct.unpack(code, state)[code.startswith(">B")] for state in client.states(5)]
        assert client.ask("P") == b"\1"
        assert [b - a for a, b in pairwise(stamps)] == pytest.approx([steps] * 4, abs=1e-6)
    assert old.ask("I", b"input_int_register_30") == b"INT32"


PARTS = [
    (0, 47), (1, 251), (4, 101), (5, 225), (9, 53), (3, 75), (2, 37), (6, 445), (7, 61), (8, 9), (10, 43), (11, 26),
    (12, 8),
]  # fmt: skip
"""Kind and size of the parts of a package that the maker's library has recorded of a controller."""


def packages(port: int, address: str, count: int) -> list[bytes]:
    with socket.create_connection((address, port), timeout=5.0) as connection:
        return list(islice(told(connection), count))


def told(connection: socket.socket) -> Iterator[bytes]:
    data = b""
    while True:
        data += connection.recv(65536)
        while len(data) >= 4 and len(data) >= (size := struct.unpack_from(">i", data)[0]):
            yield data[:size]
            data = data[size:]


@pytest.mark.parametrize("port", [30001, 30002, 30011, 30012])
def test_the_state_has_the_parts_of_a_recorded_one(address: str, port: int) -> None:
    greeting, state = packages(port, address, 2)
    assert greeting[4] == 20
    assert state[4] == 16
    parts, at = [], 5
    while at < len(state):
        size, kind = struct.unpack_from(">IB", state, at)
        parts.append((kind, size))
        at += size
    assert parts == PARTS


@pytest.mark.parametrize("port", [30003, 30013])
def test_the_real_time_port_sends_1220_bytes_in_every_cycle(address: str, port: int) -> None:
    found = packages(port, address, 20)
    assert {len(packet) for packet in found} == {1220}
    numbers = [struct.unpack_from(">152d", packet, 4) for packet in found]
    steps = [b[0] - a[0] for a, b in pairwise(numbers)]
    assert min(steps) == pytest.approx(0.002, abs=1e-6)
    assert numbers[0][31:37] == pytest.approx([0, -1.5708, -1.5708, -1.5708, 1.5708, 0], abs=1e-3)
    assert numbers[0][94] == 7.0, "the robot's mode"
    assert numbers[0][131] == 1.0, "no program"


def test_the_primary_port_tells_of_programs_and_those_for_reading_take_none(address: str) -> None:
    reading = socket.create_connection((address, 30011), timeout=5.0)
    sending = socket.create_connection((address, 30002), timeout=5.0)
    with reading, sending:
        reading.sendall(b'textmsg("from the port that takes nothing")\n')
        reading.recv(10)
        sending.sendall(b'def hello():\n  textmsg("hello ", 5)\nend\n')
        heard = b""
        while b"STOPPEDhello" not in heard:
            heard += reading.recv(4096)
    assert heard.index(b"PROGRAM_XXX_STARTEDhello") < heard.index(b"hello 5") < heard.index(b"STOPPEDhello")
    assert b"takes nothing" not in heard


def test_a_protective_stop_is_told_with_a_state_that_shows_it_and_this_port_unlocks_at_once(address: str) -> None:
    """The maker's library sends its next command on the first of these messages, whatever state it has seen last."""
    with socket.create_connection((address, 30001), timeout=5.0) as primary:
        heard = told(primary)
        next(heard)
        for command, stopped, mode in (("protective_stop()", 1, 3), ("set unlock protective stop", 0, 1)):
            primary.sendall(command.encode() + b"\n")
            state = b""
            for package in heard:
                if package[4] == 16:
                    state = package
                elif package[14] == 5:
                    break
            assert state[22] == stopped, "the flag of the state's first part"
            assert package[23] == mode and len(package) == 32
            stamp = struct.unpack_from(">Q", package, 5)[0]
            if stopped:
                warning = next(package for package in heard if package[4] == 20)
                assert warning[14] == 6 and struct.unpack_from(">iii", warning, 15) == (209, 0, 2), "C209A0, a warning"
                assert b"Protective stop" in warning
                at = stamp
        assert stamp - at < 250_000, "the dashboard of this arm would make us wait 300 ms"


def test_a_program_that_does_not_compile_is_told_as_a_controller_tells_it(address: str) -> None:
    with socket.create_connection((address, 30001), timeout=5.0) as primary:
        primary.sendall(b"def illegal_fun():\n  calldoesntexist()\nend\n")
        error = next(package for package in told(primary) if package[4] == 20 and package[14] == 10)
    assert struct.unpack_from(">ii", error, 15) == (2, 3)
    assert error[23:] == b"compile_error_name_not_found:calldoesntexist:"


def test_in_local_control_only_questions_are_answered(address: str, running: ArmBench) -> None:
    running.ask("local_control")
    refused = "Command is not allowed due to safety reasons, please switch robot to Remote Control mode"
    remote, power, mode = dashboard(address, "is in remote control", "power off", "robotmode")
    assert (remote, mode) == ("false", "Robotmode: RUNNING")
    assert power.startswith(refused)
    with socket.create_connection((address, 30001), timeout=5.0) as primary:
        primary.sendall(b"power off\n")
        heard = b""
        while b"local control" not in heard:
            heard += primary.recv(4096)
    assert dashboard(address, "robotmode") == ["Robotmode: RUNNING"]


def test_the_dashboard_answers_as_the_makers_reference_has_it(address: str) -> None:
    asked = {
        "get operational mode": "NONE", "set operational mode manual": "Operational mode 'manual' is set",
        "set operational mode AUTOMATIC": "Operational mode 'AUTOMATIC' is set",
        "clear operational mode": "No longer controlling the operational mode. Current operational mode: 'NONE'.",
        "get loaded program": "No program loaded", "load nothing.urp": "File not found: nothing.urp",
        "load installation default.installation": "Loading installation: default.installation",
        "play": "Failed to execute: play", "pause": "Failed to execute: pause", "stop": "Stopped",
        "programState": "STOPPED <unnamed>", "isProgramSaved": "false <unnamed>", "running": "Program running: false",
        "safetystatus": "Safetystatus: NORMAL", "safetymode": "Safetymode: NORMAL", "version": "5.15.2",
        "popup hello": "showing popup", "close popup": "closing popup", "addToLog hello": "Added log message",
        "close safety popup": "closing safety popup", "generate flight report controller":
        "Flight Report generated with id: 1", "saveLog": "Log saved to disk", "brake release": "Brake releasing",
        "unlock protective stop": "Protective stop releasing", "power on": "Powering on", "quit": "Disconnected",
    }  # fmt: skip
    assert dict(zip(asked, dashboard(address, *asked), strict=True)) == asked


def test_programs_of_a_folder_are_loaded_played_and_named(tmp_path) -> None:
    (tmp_path / "waiting.script").write_text("def waiting():\n  while True:\n    sync()\n  end\nend\n")
    command = [sys.executable, "-m", "sim_backends.peers.arm.rtde.server", "--programs", str(tmp_path), "--until-eof"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        address = process.stdout.readline().strip()
        answers = dashboard(address, "load waiting.urp", "get loaded program", "play", "programState", "pause", "stop")
        asked = ("load /programs/waiting.urp", "programState", "play", "running", "pause", "running", "play", "running")
        deeper = dashboard(address, *asked)
        process.stdin.close()
        process.wait(10.0)
    assert answers[:5] == [
        "Loading program: waiting.urp", "Loaded program: waiting.urp", "Starting program", "PLAYING waiting.urp",
        "Pausing program",
    ]  # fmt: skip
    assert deeper == [
        "Loading program: /programs/waiting.urp", "STOPPED waiting.urp", "Starting program", "Program running: true",
        "Pausing program", "Program running: false", "Starting program", "Program running: true",
    ]  # fmt: skip

"""What the script ports tell and take, for clients that are not ours."""

import socket
import struct
from collections.abc import Iterator
from itertools import islice, pairwise

import pytest

pytestmark = pytest.mark.wire
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
def test_the_state_has_the_parts_of_a_recorded_one(address: str, port: int):
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
def test_the_real_time_port_sends_1220_bytes_in_every_cycle(address: str, port: int):
    found = packages(port, address, 20)
    assert {len(packet) for packet in found} == {1220}
    numbers = [struct.unpack_from(">152d", packet, 4) for packet in found]
    steps = [b[0] - a[0] for a, b in pairwise(numbers)]
    assert min(steps) == pytest.approx(0.002, abs=1e-6)
    assert numbers[0][31:37] == pytest.approx([0, -1.5708, -1.5708, -1.5708, 1.5708, 0], abs=1e-3)
    assert numbers[0][94] == 7.0, "the robot's mode"
    assert numbers[0][131] == 1.0, "no program"


def test_the_primary_port_tells_of_programs_and_those_for_reading_take_none(address: str):
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


def test_a_protective_stop_is_told_with_a_state_that_shows_it_and_this_port_unlocks_at_once(address: str):
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


def test_a_program_that_does_not_compile_is_told_as_a_controller_tells_it(address: str):
    with socket.create_connection((address, 30001), timeout=5.0) as primary:
        primary.sendall(b"def illegal_fun():\n  calldoesntexist()\nend\n")
        error = next(package for package in told(primary) if package[4] == 20 and package[14] == 10)
    assert struct.unpack_from(">ii", error, 15) == (2, 3)
    assert error[23:] == b"compile_error_name_not_found:calldoesntexist:"

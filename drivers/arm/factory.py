"""What the controller tells of its own kinematics: the factory's Denavit–Hartenberg table, on the primary interface.

Read once for each connection, over a socket of its own that sends nothing. An arm that does not tell is no error here:
the user's own model of it is compared with the flange that it reports, whatever that model rests on. Source:
docs/protocols.md, section 1.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.link_table import LinkTable

PORT = 30001
_STATE, _KINEMATICS = 16, 5
_HEAD = struct.Struct(">iB")
_PART = struct.Struct(">IB")
_CONTENT = struct.Struct(">6I24dI")
_LONGEST = 1 << 16
"""Bytes; packages of a real controller have some 1500."""
_STATUS = {0: "not initialised", 1: "not linearised", 2: "linearised"}


@dataclass(frozen=True)
class FactoryKinematics:
    """The table that the controller computes with, or None and `missing` says why it is not known.

    `checksum` (6,) and `status` are the controller's own, of the calibration of its joints.
    """

    table: LinkTable | None = None
    checksum: tuple[int, ...] = ()
    status: str = ""
    missing: str = ""


def read_factory_kinematics(address: str, timeout: float = 2.0) -> FactoryKinematics:
    """Ask the controller at `address` within `timeout` wall seconds; it never raises for what the network does."""
    deadline = time.monotonic() + timeout
    try:
        with socket.create_connection((address, PORT), timeout=timeout) as connection:
            return _first(connection, deadline)
    except TimeoutError:
        why = f"port {PORT} of {address} sent none within {timeout:g} s"
    except OSError as error:
        why = f"port {PORT} of {address} cannot be read ({error})"
    except ValueError as error:
        why = f"port {PORT} of {address} sent {error}"
    return FactoryKinematics(missing=why)


def _first(connection: socket.socket, deadline: float) -> FactoryKinematics:
    while True:
        size, kind = _HEAD.unpack(_bytes(connection, _HEAD.size, deadline))
        if not _HEAD.size <= size <= _LONGEST:
            raise ValueError(f"a package of {size} bytes, allowed {_HEAD.size} to {_LONGEST}")
        content = _bytes(connection, size - _HEAD.size, deadline)
        if kind != _STATE:
            continue
        for part, data in _parts(content):
            if part == _KINEMATICS:
                return parse_kinematics_info(data)


def _parts(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Type and content of each part of a state package."""
    at = 0
    while at < len(content):
        if len(content) - at < _PART.size:
            raise ValueError(f"{len(content) - at} bytes after the last part of a state package")
        size, part = _PART.unpack_from(content, at)
        if not _PART.size <= size <= len(content) - at:
            raise ValueError(f"a part of {size} bytes where {len(content) - at} are left")
        yield part, content[at + _PART.size : at + size]
        at += size


def parse_kinematics_info(data: bytes) -> FactoryKinematics:
    """The content of a kinematics info part, 220 bytes; later versions may append. ValueError when it is none."""
    if len(data) < _CONTENT.size:
        raise ValueError(f"kinematics of {len(data)} bytes, {_CONTENT.size} are needed")
    numbers = _CONTENT.unpack_from(data)
    theta, a, d, alpha = (numbers[start : start + 6] for start in (6, 12, 18, 24))
    status = int(numbers[30])
    return FactoryKinematics(LinkTable(theta, a, d, alpha), numbers[:6], _STATUS.get(status, f"status {status}"))


def _bytes(connection: socket.socket, count: int, deadline: float) -> bytes:
    data = b""
    while len(data) < count:
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError
        connection.settimeout(left)
        chunk = connection.recv(count - len(data))
        if not chunk:
            raise ConnectionResetError("it closed the connection")
        data += chunk
    return data

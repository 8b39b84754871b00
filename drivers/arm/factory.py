"""What the controller tells of its own kinematics: the factory's Denavit–Hartenberg table, on the primary interface.

Read once for each connection of the driver, over sockets of its own that send nothing. An arm that does not tell is no
error here: the user's own model of it is compared with the flange that it reports, whatever that model rests on.
Source: docs/reference/protocols.md, section 1.
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
_NOT_INITIALISED = 0
"""The status of joints that were not calibrated since the arm was switched on: the numbers beside it are nobody's."""
_PAUSE_S = 0.5
"""Before the second try, at most."""


@dataclass(frozen=True)
class FactoryKinematics:
    """The table that the controller computes with, or None and `missing` says why it is not known."""

    table: LinkTable | None = None
    missing: str = ""


def read_factory_kinematics(address: str, timeout: float = 10.0) -> FactoryKinematics:
    """Ask the controller at `address` within `timeout` wall seconds; it never raises for what the network does.

    It tells as a connection begins, so a connection that brought nothing in half that time is followed by another.
    """
    begun = time.monotonic()
    heard: list[str] = []
    for share in (0.5, 1.0):
        try:
            return FactoryKinematics(_first(address, begun + share * timeout, heard))
        except TimeoutError:
            why = f"sent none within {timeout:g} s"
        except OSError as error:
            why = f"cannot be read ({error})"
        except ValueError as error:
            heard.append(str(error))
        if share < 1.0:
            time.sleep(min(_PAUSE_S, 0.1 * timeout))
    # What a controller has said tells more than that it then fell silent.
    return FactoryKinematics(missing=f"port {PORT} of {address} " + (f"sent {heard[-1]}" if heard else why))


def _first(address: str, deadline: float, heard: list[str]) -> LinkTable:
    """The first table of a new connection that is one; what is wrong with those before it is added to `heard`."""
    with socket.create_connection((address, PORT), timeout=deadline - time.monotonic()) as connection:
        while True:
            size, kind = _HEAD.unpack(_bytes(connection, _HEAD.size, deadline))
            if not _HEAD.size <= size <= _LONGEST:
                raise ValueError(f"a package of {size} bytes, allowed {_HEAD.size} to {_LONGEST}")
            content = _bytes(connection, size - _HEAD.size, deadline)
            if kind != _STATE:
                continue
            try:
                for part, data in _parts(content):
                    if part == _KINEMATICS:
                        return parse_kinematics_info(data)
            except ValueError as error:
                heard.append(str(error))


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


def parse_kinematics_info(data: bytes) -> LinkTable:
    """The content of a kinematics info part, 220 bytes; later versions may append. ValueError when it tells no table.

    Its checksums are of the joints' calibration and are not needed here.
    """
    if len(data) < _CONTENT.size:
        raise ValueError(f"kinematics of {len(data)} bytes, {_CONTENT.size} are needed")
    numbers = _CONTENT.unpack_from(data)
    theta, a, d, alpha = (numbers[start : start + 6] for start in (6, 12, 18, 24))
    if numbers[30] == _NOT_INITIALISED or not any(a + d):
        raise ValueError("a kinematics that is not initialised; switch the arm on")
    return LinkTable(theta, a, d, alpha)


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

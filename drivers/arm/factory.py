"""What the controller tells of its own kinematics: the factory's Denavit–Hartenberg table, on the primary interface.

Read once for each connection of the driver, over sockets of its own that send nothing. An arm that does not tell is no
error here: the user's own model of it is compared with the flange that it reports, whatever that model rests on.
Source: docs/reference/protocols.md, section 1.

Whether the arm is the one that its user computes with: flange and payload as reported and as they should be."""

import math
import socket
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from drivers.arm.faults import fault
from drivers.arm.feed import Six, Snapshot
from drivers.arm.motion import pose_difference
from drivers.interfaces import LinkTable, Vector

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
    """Ask the controller at `address` within `timeout` wall seconds; it never raises for what the network does. It
    tells as a connection begins, so a connection that brought nothing in half that time is followed by another."""
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
    Its checksums are of the joints' calibration and are not needed here."""
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


Forward = Callable[[Vector], Vector]
"""Joint angles (6,) in rad to the flange's pose (6,) in the base: x, y, z in m and a rotation vector in rad."""

MOST_WAY, MOST_TURN = 0.05e-3, 0.1e-3
"""How far the two may be apart, m and rad. With the same table they agree to the last digits; with the maker's table
instead of the factory's it is 2 to 4 mm and 7 to 15 mrad (docs/reference/protocols.md, section 1)."""

MOST_MASS, MOST_OFFSET = 1e-3, 1e-4
"""How far the payloads may be apart, kg and m: a controller shows what it was given."""


def require_same_flange(device: str, forward: Forward, snapshot: Snapshot, unknown: str = "") -> None:
    """Raise `DeviceFault` (arm.wrong_kinematics) when the two differ by more than `MOST_WAY` or `MOST_TURN`. `unknown`
    says why the controller's own table is not known, if it is not."""
    way, turn = _difference(forward, snapshot)
    if _near(way, turn):
        return
    text = (
        f"the flange that it reports is {1e3 * way:.3f} mm and {1e3 * turn:.3f} mrad away from where the cell's model "
        f"has it, allowed {1e3 * MOST_WAY:g} mm and {1e3 * MOST_TURN:g} mrad; nothing was moved"
    )
    if unknown:
        text += (
            f". The arm's own kinematics is not known ({unknown}), so the maker's table was taken. Open that port "
            "between this computer and the controller"
        )
    raise fault(device, "arm.wrong_kinematics", text)


def same_payload(snapshot: Snapshot, payload: tuple[float, Six]) -> bool:
    """True when the controller reckons with `payload`, kg and centre of gravity (3,) in m. A centre of zeros is none:
    the controller keeps the one that it had."""
    (mass, centre), (set_mass, set_centre) = snapshot.payload, payload
    near = abs(mass - set_mass) <= MOST_MASS
    return near and (not any(set_centre) or math.dist(centre, set_centre) <= MOST_OFFSET)


def require_same_payload(device: str, snapshot: Snapshot, payload: tuple[float, Six]) -> None:
    """Raise `DeviceFault` (arm.wrong_payload) unless the controller reckons with `payload`."""
    if not same_payload(snapshot, payload):
        shown, wanted = (f"{m:.3f} kg at {[round(1e3 * x, 1) for x in c]} mm" for m, c in (snapshot.payload, payload))
        raise fault(device, "arm.wrong_payload", f"{shown}, set was {wanted}; nothing was moved")


def flange_agrees(forward: Forward, snapshot: Snapshot) -> bool:
    """True when the two differ by no more than is allowed."""
    return _near(*_difference(forward, snapshot))


def _near(way: float, turn: float) -> bool:
    return way <= MOST_WAY and turn <= MOST_TURN


def _difference(forward: Forward, snapshot: Snapshot) -> tuple[float, float]:
    computed: Six = tuple(float(value) for value in forward(np.array(snapshot.joints)))
    return pose_difference(computed, snapshot.flange)

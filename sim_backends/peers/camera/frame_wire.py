"""Messages of the frame stream protocol, version 1: magic, two lengths, a JSON header, a payload."""

from __future__ import annotations

import json
import math
import socket
import struct
from typing import Any

MAGIC = b"CFS1"
_PREFIX = struct.Struct(">4sII")
_LONGEST = 64 * 1024


class Rejected(Exception):
    """A request cannot be carried out; the text goes to the client."""


def message(header: dict[str, Any], payload: bytes = b"") -> bytes:
    """The bytes of one message."""
    text = json.dumps(header).encode("utf-8")
    return _PREFIX.pack(MAGIC, len(text), len(payload)) + text + payload


def receive(connection: socket.socket) -> dict[str, Any] | None:
    """The next request's header; None at the end of the connection.

    A header that is no JSON object comes back as a request that nobody knows. Raises Rejected when the stream is not
    this protocol at all.
    """
    prefix = _read(connection, _PREFIX.size)
    if prefix is None:
        return None
    magic, length, payload = _PREFIX.unpack(prefix)
    if magic != MAGIC or length > _LONGEST or payload > _LONGEST:
        raise Rejected(
            f"not a message of frame stream version 1: it must begin with {MAGIC!r}, "
            f"header and payload of a request may have at most {_LONGEST} bytes"
        )
    text = _read(connection, length)
    if text is None or _read(connection, payload) is None:
        return None
    try:
        request = json.loads(text)
    except ValueError as error:
        return {"op": f"a header that is not JSON ({error})"}
    return request if isinstance(request, dict) else {"op": "a header that is not a JSON object"}


def number(request: dict[str, Any], key: str, default: float, low: float, high: float, unit: str) -> float:
    """The value of `key`, or `default` when it is not given; Rejected unless a number from `low` to `high`."""
    value = request.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Rejected(f"{key} {value!r} is not a number; allowed {low:g} to {high:g} {unit}")
    if not low <= value <= high:
        raise Rejected(f"{key} {value:g} {unit} is out of range; allowed {low:g} to {high:g} {unit}")
    return float(value)


def _read(connection: socket.socket, count: int) -> bytes | None:
    data = bytearray()
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            return None
        data += part
    return bytes(data)

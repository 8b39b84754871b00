"""Readings, commands and what passed on a wire as JSON: numbers keep every digit, what is no number becomes null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import can
import numpy as np
import pinocchio as pin

MOST_NUMBERS = 2000
"""Of an array that goes into a message; of a larger one its shape is told."""


def as_json(data: object) -> bytes:
    """Strict JSON."""
    try:
        return _ENCODER.encode(data).encode()
    except (ValueError, TypeError):
        # A number that is none, or a key that is no text.
        return _ENCODER.encode(plain(data)).encode()


def plain(value: object) -> Any:
    """What JSON has words for."""
    if isinstance(value, bool | str | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, np.ndarray):
        return plain(value.tolist()) if value.size <= MOST_NUMBERS else f"{'×'.join(map(str, value.shape))} numbers"
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, pin.SE3):
        return plain(value.homogeneous)
    if isinstance(value, bytes | bytearray):
        return value.hex()
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(each) for each in value]
    return str(value)


_ENCODER = json.JSONEncoder(allow_nan=False, separators=(",", ":"), default=plain)
_WORDS = (b"false", b"true")


def wire(sent: bool, what: object) -> bytes:
    """A CAN frame, or bytes, as JSON. Written out, because hundreds come in a second."""
    if isinstance(what, can.Message):
        flags = (what.is_extended_id, what.is_remote_frame, what.is_error_frame, what.is_fd)
        extended, remote, error, fd = (_WORDS[flag] for flag in flags)
        return (
            b'{"sent":%s,"id":%d,"extended":%s,"remote":%s,"error":%s,"fd":%s,"dlc":%d,"data":"%s"}'
            % (_WORDS[sent], what.arbitration_id, extended, remote, error, fd, what.dlc, what.data.hex().encode())
        )  # fmt: skip
    data = what.hex() if isinstance(what, bytes | bytearray) else str(what)
    return as_json({"sent": sent, "data": data})


def rtde(sent: bool, what: object) -> bytes:
    """What passes between arm and driver, as JSON: packets as bytes, lines of the dashboard, values, requests."""
    match what:
        case bytes() | bytearray():
            return as_json({"sent": sent, "data": what.hex()})
        case str():
            return as_json({"sent": sent, "text": what})
        case (str() as name, tuple() as arguments):
            return as_json({"sent": sent, "request": name, "arguments": arguments})
    return as_json({"sent": sent, "state": vars(what)})

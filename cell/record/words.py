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
    return json.dumps(plain(data), allow_nan=False, separators=(",", ":")).encode()


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


def wire(sent: bool, what: object) -> dict[str, object]:
    """A CAN frame, or bytes."""
    if isinstance(what, can.Message):
        return {
            "sent": sent, "id": what.arbitration_id, "extended": what.is_extended_id, "remote": what.is_remote_frame,
            "error": what.is_error_frame, "dlc": what.dlc, "fd": what.is_fd, "data": bytes(what.data).hex(),
        }  # fmt: skip
    return {"sent": sent, "data": bytes(what).hex() if isinstance(what, bytes | bytearray) else str(what)}


def rtde(sent: bool, what: object) -> dict[str, object]:
    """What passes between the arm and its driver: packets as bytes, lines of the dashboard, values, requests."""
    match what:
        case bytes() | bytearray():
            return {"sent": sent, "data": bytes(what).hex()}
        case str():
            return {"sent": sent, "text": what}
        case (str() as name, tuple() as arguments):
            return {"sent": sent, "request": name, "arguments": arguments}
    return {"sent": sent, "state": what}

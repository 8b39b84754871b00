"""Messages of the frame stream protocol, version 1 (docs/reference/frame-stream.md): magic, lengths, JSON header,
payload."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any

MAGIC = b"CFS1"
PREFIX = struct.Struct(">4sII")
MAX_HEADER = 64 * 1024
MAX_PAYLOAD = 256 * 1024 * 1024

Header = dict[str, Any]


class StreamError(ValueError):
    """Bytes that are no message of this protocol; the stream cannot be followed any further."""


def encode(header: Header, payload: bytes = b"") -> bytes:
    """The bytes of one message."""
    text = json.dumps(header).encode("utf-8")
    return PREFIX.pack(MAGIC, len(text), len(payload)) + text + payload


def read(receive: Callable[[int], bytearray]) -> tuple[Header, bytearray]:
    """Read one message; `receive(n)` returns exactly n bytes or raises. Raises `StreamError`."""
    magic, header_length, payload_length = PREFIX.unpack(receive(PREFIX.size))
    if magic != MAGIC:
        raise StreamError(f"a message begins with {magic!r} instead of {MAGIC!r}")
    if header_length > MAX_HEADER or payload_length > MAX_PAYLOAD:
        raise StreamError(f"a message announces {header_length} + {payload_length} bytes")
    try:
        header = json.loads(receive(header_length))
    except ValueError as error:
        raise StreamError(f"a header is not JSON: {error}") from error
    if not isinstance(header, dict):
        raise StreamError(f"a header is {type(header).__name__} instead of an object")
    return header, receive(payload_length)

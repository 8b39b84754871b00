"""Messages of a record that need no geometry: pictures and lines of the log."""

from __future__ import annotations

import logging
from typing import Any

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log


def stamp(message: Any, at: int) -> None:
    """Set a message's `timestamp`, ns."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(at, 1_000_000_000)


def image(at: int, camera: str, png: bytes) -> bytes:
    """A picture of a camera."""
    message = CompressedImage(frame_id=camera, data=png, format="png")
    stamp(message, at)
    return bytes(message.SerializeToString())


def log_line(at: int, record: logging.LogRecord, text: str) -> bytes:
    """A line of the log; its level is a tenth of Python's."""
    level: Any = min(record.levelno // 10, 5)
    message = Log(level=level, message=text, name=record.name, file=record.filename, line=record.lineno)
    stamp(message, at)
    return bytes(message.SerializeToString())

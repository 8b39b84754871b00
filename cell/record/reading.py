"""Reading a record: whole ones by the library's reader, one that was cut off as far as it goes."""

from __future__ import annotations

import json
import struct
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from cell.record.file import message_class, require_packages
from drivers.errors import CellError, ConfigError

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 1, 2, 3, 4, 5, 6, 12, 15
"""Kinds of records in the file, each one byte, then eight for the length of what follows. Source: the MCAP
specification, https://mcap.dev/spec."""
_HEAD, _CHUNK = struct.Struct("<BQ"), struct.Struct("<QQQI")
LONGEST = 1 << 32
"""A record that says it is longer than that is no record."""


@dataclass
class Parts:
    """What a file holds, in its order: each record's kind and content. `whole` once its proper end was reached; else
    `lost` bytes at the end are of no use."""

    whole: bool = False
    lost: int = 0


def parts(stream: IO[bytes], told: Parts) -> Iterator[tuple[int, bytes]]:
    """The records of a file one after the other, those of chunks as well, as far as they are whole.

    `told` says afterwards how the file ended. `CellError` for a file that never was a record.
    """
    size = stream.seek(0, 2)
    stream.seek(0)
    start = stream.read(len(MAGIC))
    if not MAGIC.startswith(start):
        raise CellError("it does not begin as an MCAP file does")
    good = stream.tell()
    while len(head := stream.read(_HEAD.size)) == _HEAD.size:
        kind, length = _HEAD.unpack(head)
        content = stream.read(min(length, LONGEST))
        if kind == 0 or len(content) < length:
            if kind == CHUNK:
                good += _HEAD.size + (yield from _inside(content))
            break
        good = stream.tell()
        if kind == CHUNK:
            yield from _inside(content)
        elif kind == FOOTER:
            told.whole = stream.read(len(MAGIC)) == MAGIC
            good = stream.tell()
            break
        else:
            yield kind, content
    told.lost = size - good


def _inside(chunk: bytes) -> Generator[tuple[int, bytes], None, int]:
    """The records of a chunk that is not compressed, as far as they are there; returns how many bytes that were."""
    if len(chunk) < _CHUNK.size + 4:
        return 0
    (name,) = struct.unpack_from("<I", chunk, _CHUNK.size)
    inside = BytesIO(chunk)
    inside.seek(_CHUNK.size + 4 + name + 8)
    if name:
        raise CellError("its chunks are compressed: another program wrote it, which has to repair it")
    good = inside.tell()
    while len(head := inside.read(_HEAD.size)) == _HEAD.size:
        kind, length = _HEAD.unpack(head)
        content = inside.read(length)
        if len(content) < length:
            break
        good = inside.tell()
        yield kind, content
    return good


@dataclass(frozen=True)
class Said:
    """A message as it lies in the file: its topic, its schema's name, its encoding, its time in ns, its bytes."""

    topic: str
    schema: str
    encoding: str
    at: int
    data: bytes

    def decoded(self) -> Any:
        """JSON as data, Protobuf as its message."""
        if self.encoding == "json":
            return json.loads(self.data)
        message = message_class(self.schema)()
        message.ParseFromString(self.data)
        return message


def said(path: Path, told: Parts, topics: tuple[str, ...] = ("/",)) -> Iterator[Said]:
    """The messages of the topics that begin so, in the file's order, as far as the file goes; `told` as in `parts`.

    `ConfigError` without a file, `CellError` for one that is no record, or where a package for it is not installed.
    """
    if not path.is_file():
        raise ConfigError(f"there is no {path}; a run of an older version leaves none")
    require_packages()
    from mcap.data_stream import ReadDataStream
    from mcap.records import Channel, Message, Schema

    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open("rb") as stream:
        for kind, content in parts(stream, told):
            data = ReadDataStream(BytesIO(content))
            if kind == SCHEMA:
                schema = Schema.read(data)
                schemas[schema.id] = schema
            elif kind == CHANNEL:
                channel = Channel.read(data)
                channels[channel.id] = channel
            elif kind == MESSAGE:
                of = channels.get(int.from_bytes(content[:2], "little"))
                if of is not None and of.topic.startswith(topics):
                    message = Message.read(data, len(content))
                    schema = schemas[of.schema_id]
                    yield Said(of.topic, schema.name, of.message_encoding, message.log_time, message.data)


def messages(path: Path, topics: tuple[str, ...]) -> Iterator[tuple[str, int, Any]]:
    """As `said`, decoded: topic, time in ns, the message."""
    for message in said(path, Parts(), topics):
        yield message.topic, message.at, message.decoded()

"""Closes the record of a run that was cut off: all whole messages, in their order, with the index that readers want."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from cell.base.storage import replacing
from cell.run.record.file import CHUNK_BYTES, require_packages
from cell.run.record.reading import CHANNEL, MESSAGE, METADATA, SCHEMA, Parts, decoding, parts
from drivers.errors import CellError, ConfigError

DAMAGED = ".damaged"


@dataclass(frozen=True)
class Repaired:
    """What became of a file: it was `whole` already (one without a message too), or so many `messages` were kept and
    `lost` bytes let go. Where `damaged` names anything, the old file is kept beside it, with `DAMAGED` at its end."""

    whole: bool
    messages: int
    lost: int
    damaged: tuple[str, ...] = ()


def repair(path: Path, progress: Callable[[float, str], None] = lambda fraction, text: None) -> Repaired:
    """Close the file at `path`, in its place. `ConfigError` without a file, `CellError` for what is no record."""
    if not path.is_file():
        raise ConfigError(f"there is no {path}; a run of an older version leaves none")
    require_packages()
    told, copied = Parts(), 0
    try:
        with path.open("rb") as stream, suppress(_WholeError), replacing(path) as out:
            copy = _Copy(out)
            size = max(1, path.stat().st_size)
            for kind, content in parts(stream, told):
                with decoding(told):
                    copy.take(kind, content)
                if copy.messages % 1000 == 0:
                    progress(stream.tell() / size, f"{copy.messages} messages")
            copied = copy.messages
            if told.whole:
                raise _WholeError
            copy.finish()
            if told.damaged:
                shutil.copyfile(path, path.with_name(path.name + DAMAGED))
    except CellError as error:
        raise CellError(f"{path} cannot be repaired: {error}") from error
    except OSError as error:
        raise CellError(f"{path} cannot be repaired: {error}; it is as it was") from error
    return Repaired(told.whole, copied, 0 if told.whole else told.lost, tuple(told.damaged))


class _WholeError(Exception):
    """Nothing is to be replaced."""


class _Copy:
    """A new file with the same schemas, channels and messages."""

    def __init__(self, out: IO[bytes]) -> None:
        from mcap.writer import CompressionType, Writer

        self.messages = 0
        self._writer: Any = Writer(out, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE, enable_data_crcs=True)
        self._writer.start(profile="", library="assembly-cell")
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def take(self, kind: int, content: bytes) -> None:
        """One record of the old file; a message whose channel was lost is let go."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel, Message, Metadata, Schema

        data = ReadDataStream(BytesIO(content))
        if kind == SCHEMA:
            schema = Schema.read(data)
            if schema.id not in self._schemas:
                self._schemas[schema.id] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        elif kind == CHANNEL:
            channel = Channel.read(data)
            if channel.id not in self._channels and channel.schema_id in self._schemas:
                self._channels[channel.id] = self._writer.register_channel(
                    channel.topic, channel.message_encoding, self._schemas[channel.schema_id], channel.metadata
                )
        elif kind == MESSAGE:
            message = Message.read(data, len(content))
            if message.channel_id in self._channels:
                self.messages += 1
                self._writer.add_message(
                    self._channels[message.channel_id],
                    message.log_time,
                    message.data,
                    message.publish_time,
                    message.sequence,
                )
        elif kind == METADATA:
            metadata = Metadata.read(data)
            self._writer.add_metadata(metadata.name, metadata.metadata)

    def finish(self) -> None:
        """The end of the file."""
        self._writer.finish()

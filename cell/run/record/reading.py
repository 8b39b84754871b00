"""Reading a record, as far as it goes where it was cut off: its messages, its figures, its wires for other programs.

`repair` closes the record of a run that was cut off: all whole messages in their order, and the index readers want.
"""

import json
import shutil
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from cell.base.storage import replacing
from cell.run.record.file import begun, message_class, require_packages
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
    """How a file ended: `closed` once its proper end was reached; else `lost` bytes at the end are of no use. `damaged`
    names what does not fit its CRC, and where; chunks among it are left out, `lost` counts their bytes."""

    closed: bool = False
    lost: int = 0
    damaged: list[str] = field(default_factory=list)

    @property
    def whole(self) -> bool:
        """Closed, and every byte as it was written, as far as CRCs tell."""
        return self.closed and not self.damaged


def parts(stream: IO[bytes], told: Parts) -> Iterator[tuple[int, bytes]]:
    """The records of a file one after the other, those of chunks as well, as far as they are whole. `told` says
    afterwards how the file ended. `CellError` for a file that never was a record."""
    size = stream.seek(0, 2)
    good, crc, summary = *_begin(stream), False
    while len(head := stream.read(_HEAD.size)) == _HEAD.size:
        kind, length = _HEAD.unpack(head)
        content = stream.read(min(length, LONGEST))
        if kind == 0 or len(content) < length:
            stream.seek(max(0, size - len(MAGIC)))
            if good > len(MAGIC) and stream.read() == MAGIC:
                told.damaged.append(f"the record at byte {good} says that it is {length} bytes long")
            elif kind == CHUNK:
                good += _HEAD.size + (yield from _inside(content))
            break
        here, good = good, stream.tell()
        if kind == CHUNK:
            if _crc_fits(content):
                yield from _inside(content)
            else:
                told.damaged.append(f"the chunk at byte {here}, {len(content)} bytes long")
                told.lost += len(content)
                index = _summary(stream, size)
                stream.seek(good)
                # Later messages need the channels that stood in it; the index repeats them.
                yield from filter(lambda record: record[0] in (SCHEMA, CHANNEL), _records(BytesIO(index)))
        elif kind == DATA_END:
            # 0: not reckoned, in records of older versions.
            if int.from_bytes(content[:4], "little") not in (0, crc) and not told.damaged:
                told.damaged.append(f"something between its chunks, before byte {here}")
            crc, summary = 0, True
            continue
        elif kind == FOOTER:
            if content[16:20] not in (bytes(4), zlib.crc32(head + content[:16], crc).to_bytes(4, "little")):
                told.damaged.append(f"the index that ends at byte {here}")
            told.closed = stream.read(len(MAGIC)) == MAGIC
            good = stream.tell()
            break
        elif not summary:
            yield kind, content
        crc = zlib.crc32(content, zlib.crc32(head, crc))
    told.lost += size - good


def _begin(stream: IO[bytes]) -> tuple[int, int]:
    """How long the file's first word is, and its CRC; `CellError` where it is another one."""
    stream.seek(0)
    start = stream.read(len(MAGIC))
    if not MAGIC.startswith(start):
        raise CellError("it does not begin as an MCAP file does")
    return stream.tell(), zlib.crc32(start)


@contextmanager
def decoding(told: Parts) -> Iterator[None]:
    """A record that cannot be decoded is damage: one of an older version, where no CRC showed it before."""
    try:
        yield
    except (CellError, OSError):
        raise
    except Exception as error:
        # The library raises whatever its bytes lead it to.
        told.damaged.append(f"a record that cannot be decoded ({type(error).__name__}: {error})")


def _crc_fits(chunk: bytes) -> bool:
    """Whether the records of a chunk fit its CRC; one that is compressed is not looked into."""
    if len(chunk) < _CHUNK.size + 12:
        return False
    expected, name = struct.unpack_from("<I", chunk, _CHUNK.size - 4)[0], chunk[_CHUNK.size : _CHUNK.size + 8]
    if name[:4] != bytes(4):
        return name[4:].startswith((b"zstd", b"lz4"))
    return expected in (0, zlib.crc32(chunk[_CHUNK.size + 12 :]))


def _summary(stream: IO[bytes], size: int) -> bytes:
    """The section with the index, which repeats schemas and channels; empty where the file was cut off."""
    end = len(MAGIC) + _HEAD.size + 20
    stream.seek(max(0, size - end))
    foot = stream.read()
    if len(foot) < end or foot[0] != FOOTER or not foot.endswith(MAGIC):
        return b""
    stream.seek(min(int.from_bytes(foot[_HEAD.size : _HEAD.size + 8], "little"), size))
    index = stream.read()[:-end]
    fits = zlib.crc32(index + foot[: _HEAD.size + 16]).to_bytes(4, "little") == foot[_HEAD.size + 16 : _HEAD.size + 20]
    return index if fits else b""


def _inside(chunk: bytes) -> Generator[tuple[int, bytes], None, int]:
    """The records of a chunk that is not compressed, as far as they are there; returns how many bytes that were."""
    if len(chunk) < _CHUNK.size + 4:
        return 0
    (name,) = struct.unpack_from("<I", chunk, _CHUNK.size)
    inside = BytesIO(chunk)
    inside.seek(_CHUNK.size + 4 + name + 8)
    if name:
        raise CellError("its chunks are compressed: another program wrote it, which has to repair it")
    return (yield from _records(inside))


def _records(inside: BytesIO) -> Generator[tuple[int, bytes], None, int]:
    good = inside.tell()
    while len(head := inside.read(_HEAD.size)) == _HEAD.size:
        kind, length = _HEAD.unpack(head)
        content = inside.read(min(length, LONGEST))
        if len(content) < length:
            break
        good = inside.tell()
        yield kind, content
    return good


@dataclass(frozen=True)
class StoredMessage:
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


def said(path: Path, told: Parts, topics: tuple[str, ...] = ("/",)) -> Iterator[StoredMessage]:
    """The messages of the topics that begin so, in the file's order, as far as the file goes; `told` as in `parts`.
    `ConfigError` without a file, `CellError` for one that is no record, or where a package for it is not installed."""
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
            found: StoredMessage | None = None
            with decoding(told):
                if kind == SCHEMA:
                    schema = Schema.read(data)
                    schemas[schema.id] = schema
                elif kind == CHANNEL:
                    channel = Channel.read(data)
                    channels[channel.id] = channel
                elif kind == MESSAGE:
                    of = channels.get(int.from_bytes(content[:2], "little"))
                    if of is not None and of.schema_id in schemas and of.topic.startswith(topics):
                        message, name = Message.read(data, len(content)), schemas[of.schema_id].name
                        found = StoredMessage(of.topic, name, of.message_encoding, message.log_time, message.data)
            if found is not None:
                yield found


def messages(path: Path, topics: tuple[str, ...]) -> Iterator[tuple[str, int, Any]]:
    """As `said`, decoded: topic, time in ns, the message."""
    for message in said(path, Parts(), topics):
        yield message.topic, message.at, message.decoded()


def information(path: Path) -> dict[str, Any]:
    """Its channels with their messages and bytes, its span in s, whether it is whole, what was let go, by topic.

    It is `whole` when it was closed, its CRCs fit (`damaged` names what does not) and it holds a message.

    `dropped` is None where the record was cut off before it could tell. `cpu_s` of a core were taken to write it: None
    then, and on the virtual clock. Raises as `said` does.
    """
    counts: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    schemas: dict[str, str] = {}
    times: list[int] = []
    end: dict[str, Any] = {}
    told = Parts()
    try:
        for message in said(path, told):
            counts[message.topic] += 1
            sizes[message.topic] += len(message.data)
            schemas[message.topic] = message.schema
            times = [min([message.at, *times]), max([message.at, *times])]
            if message.topic == "/record/end":
                with decoding(told):
                    end = dict(json.loads(message.data))
    except CellError as error:
        raise CellError(f"{path}: {error}") from error
    return {
        "file": str(path), "bytes": path.stat().st_size, "whole": told.whole and counts.total() > 0,
        "closed": told.closed, "damaged": told.damaged, "lost_bytes": told.lost, "messages": counts.total(),
        "begun_ns": times[0] if times else None,
        "span_s": round(1e-9 * (times[1] - times[0]), 3) if times else None,
        "dropped": end.get("dropped"), "cpu_s": end.get("cpu_s"),
        "channels": [
            {"topic": topic, "schema": schemas[topic], "messages": counts[topic], "bytes": sizes[topic]}
            for topic in sorted(counts)
        ],
    }  # fmt: skip


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
        self.messages = 0
        self._writer = begun(out)
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def take(self, kind: int, content: bytes) -> None:
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
                at = self._channels[message.channel_id]
                self._writer.add_message(at, message.log_time, message.data, message.publish_time, message.sequence)
        elif kind == METADATA:
            metadata = Metadata.read(data)
            self._writer.add_metadata(metadata.name, metadata.metadata)

    def finish(self) -> None:
        self._writer.finish()


ERROR_FLAG = 0x20000000
CAN, WIRES = "/vehicle/can", ("/vehicle/can", "/arm/rtde", "/rail/serial", "/laser/serial", "/claw/serial")


def as_candump(record: Path, out: Path, bus: str = "can0") -> int:
    """Write the CAN frames in candump's log format, with R for those that came and T for those sent; their number."""
    count = 0
    with out.open("w", encoding="ascii") as file:
        for _, at, told in messages(record, (CAN,)):
            way = "T" if told["sent"] else "R"
            file.write(f"({at // 10**9}.{at % 10**9 // 1000:06d}) {bus} {candump_frame(told)} {way}\n")
            count += 1
    return count


def candump_frame(told: dict[str, Any]) -> str:
    """A frame as candump's log has it. Source: `sprint_canframe` of can-utils and the headers of SocketCAN."""
    if told["error"]:
        return f"{ERROR_FLAG | told['id']:08X}#{told['data'].upper()}"
    number = f"{told['id']:08X}" if told["extended"] else f"{told['id']:03X}"
    if told["remote"]:
        # The length that is asked for; none stands for 0.
        return f"{number}#R{told['dlc'] or ''}"
    return f"{number}#{'#0' if told['fd'] else ''}{told['data'].upper()}"


def as_text(record: Path, out: Path) -> int:
    """Write all raw traffic as lines: time in s, wire, > for what was sent and < for what came, data; their number."""
    count = 0
    with out.open("w", encoding="utf-8") as file:
        for line in lines(record):
            file.write(f"{line}\n")
            count += 1
    return count


def lines(record: Path) -> Iterator[str]:
    """The lines of `as_text`."""
    for topic, at, told in messages(record, WIRES):
        say = _can if topic == CAN else _other
        yield f"{at // 10**9}.{at % 10**9:09d} {topic} {'>' if told['sent'] else '<'} {say(told)}"


def _can(told: dict[str, Any]) -> str:
    number = f"{told['id']:08X}" if told["extended"] else f"{told['id']:03X}"
    kind = " error" if told["error"] else " remote" if told["remote"] else ""
    return f"{number}{kind} [{told['dlc']}] {_spaced(told['data'])}".rstrip()


def _other(told: dict[str, Any]) -> str:
    if "data" in told:
        data = bytes.fromhex(told["data"])
        shown = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in data)
        return f"{_spaced(told['data'])}  |{shown}|"
    if "text" in told:
        return f"dashboard {told['text']!r}"
    return f"{told['request']} {told['arguments']}" if "request" in told else f"state {told['state']}"


def _spaced(data: str) -> str:
    return " ".join(data[k : k + 2] for k in range(0, len(data), 2))


FORMATS: dict[str, tuple[str, Callable[[Path, Path], int]]] = {
    "candump": (".candump.log", as_candump),
    "text": (".wires.txt", as_text),
}
"""By name: how the file's name ends, and what writes it."""

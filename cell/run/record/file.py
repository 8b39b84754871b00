"""The file `record.mcap` and its channels (docs/reference/record.md), written by a thread of its own.

That thread makes the messages, too: what is put in is how to make them, and nobody waits for the disk. Chunks are small
and go to the system once a second, so that a run that is cut off loses little. They are not compressed: the pictures
are, and the rest is little. Geometry is in Foxglove's Protobuf schemas; what only this cell
knows is JSON with a schema.
"""

import json
import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

from cell.base.storage import sync_folder
from drivers.errors import CellError

FOXGLOVE = "foxglove."


@dataclass(frozen=True)
class Channel:
    """A channel; `{device}` in its topic stands for each of `devices`. `what` is told in the documentation."""

    topic: str
    schema: str
    what: str
    devices: tuple[str, ...] = ()

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that it stands for."""
        return tuple(self.topic.format(device=device) for device in self.devices) or (self.topic,)

    @property
    def encoding(self) -> str:
        """Of its messages."""
        return "protobuf" if self.schema.startswith(FOXGLOVE) else "json"


GATED = ("arm", "rail", "vehicle", "laser", "claw")
CAMERAS = ("scan_camera", "target_camera")
COMMANDED = (*GATED, *CAMERAS)
CHANNELS = (
    Channel("/tf", "foxglove.FrameTransforms", "base, arm's joints, flange, cameras; `tf#/` → `base` is identity"),
    Channel("/joints", "foxglove.JointStates", "the arm's six joints in rad, the rail in m"),
    Channel("/scene", "foxglove.SceneUpdate", "the bodies that the planner keeps apart, when one comes, goes or moves"),
    Channel("/{device}/image", "foxglove.CompressedImage", "two kept frames a second, PNG as in `frames/`", CAMERAS),
    Channel("/{device}/calibration", "foxglove.CameraCalibration", "its lens, with each frame of a job", CAMERAS),
    Channel("/{device}/frame", "cell.Frame", "that frame's number, file, exposure, device's and host's time", CAMERAS),
    Channel("/cloud/line", "foxglove.PointCloud", "one line of the cloud in the base, at the time that it was taken"),
    Channel("/cloud/whole", "foxglove.PointCloud", "all lines, with the last"),
    Channel("/sequence/state", "cell.State", "the sequence goes from one state to another"),
    Channel("/sequence/event", "cell.Event", "all that the run tells; progress at most five times a second"),
    Channel("/log", "foxglove.Log", "what the modules log"),
    Channel("/{device}/command", "cell.Command", "what it was asked to do; why that was refused, if it was", COMMANDED),
    Channel("/{device}/state", "cell.Reading", "what the cell has read of it, at most 30 times a second", GATED),
    Channel("/vehicle/can", "cell.Can", "each CAN frame that the driver sent or heard, its data in hex"),
    Channel("/{device}/serial", "cell.Bytes", "bytes on its serial line or socket, in hex", ("rail", "laser", "claw")),
    Channel("/arm/rtde", "cell.Rtde", "RTDE packets, the values of each state, requests, dashboard lines"),
    Channel("/record/end", "cell.End", "the last message: what was let go, by topic; s of a core it took"),
)  # fmt: skip

_NUMBER, _TEXT, _OBJECT, _TRUTH = ({"type": kind} for kind in ("number", "string", "object", "boolean"))
_FIELDS: dict[str, dict[str, object]] = {
    "cell.Frame": {
        "file": _TEXT, "frame_id": _NUMBER, "exposure": _NUMBER, "device_time": _NUMBER, "host_time": _NUMBER,
        "received": _NUMBER, "lost_before": _NUMBER,
    },
    "cell.State": {"trigger": _TEXT, "from": _TEXT, "to": _TEXT},
    "cell.Event": {"kind": _TEXT, "step": _TEXT, "data": _OBJECT},
    "cell.Command": {"name": _TEXT, "arguments": _OBJECT, "refused": _TEXT},
    "cell.Reading": {"stamp": _NUMBER},
    "cell.Can": {"sent": _TRUTH, "id": _NUMBER, "extended": _TRUTH, "remote": _TRUTH, "error": _TRUTH, "dlc": _NUMBER,
                 "fd": _TRUTH, "data": _TEXT},
    "cell.Bytes": {"sent": _TRUTH, "data": _TEXT},
    "cell.Rtde": {"sent": _TRUTH, "data": _TEXT, "text": _TEXT, "request": _TEXT, "state": _OBJECT},
    "cell.End": {"dropped": _OBJECT, "cpu_s": _NUMBER},
}  # fmt: skip
"""By schema: its fields. Not all of them are in each message, and a reading has those of its device."""


BY_TOPIC = {topic: channel for channel in CHANNELS for topic in channel.topics}


FILE = "record.mcap"
NEEDED = ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf")
MOST_WAITING = 20_000
"""Messages that may wait; beyond that new ones are let go, and counted. A second of the busiest wires has a tenth."""
CHUNK_BYTES = 128 * 1024
FLUSH_S, LOOK_S, TIMEOUT_S = 1.0, 0.05, 20.0
"""Wall seconds: between two flushes, between two looks at what waits, and until a writer at the end counts as stuck."""

Make = Callable[[], bytes | None]
"""Makes a message's bytes; None when there is nothing to write."""

log = logging.getLogger(__name__)


def missing() -> list[str]:
    """The packages that a record needs and that are not installed."""
    return [name for name in NEEDED if find_spec(name) is None]


def require_packages() -> None:
    """Raise `CellError` when one of them is not installed."""
    if absent := missing():
        names = " ".join(name.replace("_", "-") for name in absent)
        raise CellError(f"records cannot be read or written without {names}; pip install {names}")


class RecordFile:
    """A record that is being written. `put` may be called from any thread."""

    def __init__(self, path: Path, facts: dict[str, str], *, lossless: bool) -> None:
        """`facts` go into the file's metadata. A `lossless` one makes whoever puts too much wait instead."""
        self.path = path
        self.dropped: Counter[str] = Counter()
        self.failure: str | None = None
        self.cpu_s = 0.0
        """What the writer's thread has taken of a core."""
        self.messages = 0
        self._facts = facts
        self._lossless = lossless
        self._waiting: deque[tuple[str, int, Make]] = deque()
        self._ending = threading.Event()
        self._sequence: Counter[str] = Counter()
        self._thread = threading.Thread(target=self._run, name="record", daemon=True)
        self._thread.start()

    def put(self, topic: str, at: int, make: Make) -> None:
        """Have a message written with its time `at`, ns."""
        if self.failure is not None or self._ending.is_set():
            return
        while len(self._waiting) >= MOST_WAITING:
            if not self._lossless or not self._thread.is_alive():
                self.dropped[topic] += 1
                return
            time.sleep(0.001)
        self._waiting.append((topic, at, make))

    def close(self) -> None:
        """Write what waits, and the end. Idempotent."""
        self._ending.set()
        self._thread.join(TIMEOUT_S)
        if self._thread.is_alive():
            self.failure = f"the record was still being written {TIMEOUT_S:.0f} s after the end"

    def _run(self) -> None:
        try:
            with self.path.open("wb") as stream:
                self._write(_Out(stream, self._facts))
                stream.flush()
                os.fsync(stream.fileno())
            sync_folder(self.path.parent)
        except Exception as error:
            # The run goes on without it.
            self.failure = f"{type(error).__name__}: {error}"
            self._waiting.clear()
            log.warning("the record of this run cannot be written: %s", self.failure)

    def _write(self, out: "_Out") -> None:
        flushed = time.monotonic()
        while True:
            ending = self._ending.wait(LOOK_S)
            last = self._drain(out)
            if ending:
                break
            if not self._lossless and time.monotonic() - flushed > FLUSH_S:
                out.writer.flush()
                flushed = time.monotonic()
            self.cpu_s = time.thread_time()
        end = {"dropped": dict(self.dropped), "cpu_s": None if self._lossless else round(time.thread_time(), 3)}
        out.add("/record/end", last, json.dumps(end).encode(), 1)
        out.writer.finish()
        self.cpu_s = time.thread_time()

    def _drain(self, out: "_Out") -> int:
        while self._waiting:
            topic, at, make = self._waiting.popleft()
            try:
                data = make()
            except Exception as error:
                self.dropped[topic] += 1
                log.debug("no message for %s: %s: %s", topic, type(error).__name__, error)
                continue
            if data is not None:
                self._sequence[topic] += 1
                self.messages += 1
                out.add(topic, at, data, self._sequence[topic])
        return out.newest


def begun(stream: IO[bytes]) -> Any:
    """The library's writer on an empty file, as all records are written."""
    # Called in the writer's thread: a job's start does not wait for these packages.
    from mcap.writer import CompressionType, Writer

    writer: Any = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE, enable_data_crcs=True)
    writer.start(profile="", library="assembly-cell")
    return writer


class _Out:
    """The library's writer, and the channels that it knows by now."""

    def __init__(self, stream: IO[bytes], facts: dict[str, str]) -> None:
        self.newest = 0
        self.writer = begun(stream)
        self.writer.add_metadata("run", facts)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def add(self, topic: str, at: int, data: bytes, sequence: int) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            about = BY_TOPIC[topic]
            channel = self.writer.register_channel(topic, about.encoding, self._schema(about.schema))
            self._channels[topic] = channel
        self.newest = max(self.newest, at)
        self.writer.add_message(channel, at, data, at, sequence)

    def _schema(self, name: str) -> int:
        if name not in self._schemas:
            if name.startswith("foxglove."):
                from mcap_protobuf.schema import register_schema

                self._schemas[name] = register_schema(self.writer, message_class(name))
            else:
                fields = json.dumps({"title": name, "type": "object", "properties": _FIELDS[name]}).encode()
                self._schemas[name] = self.writer.register_schema(name, "jsonschema", fields)
        return self._schemas[name]


def message_class(name: str) -> Any:
    """The class of a Foxglove message by its full name."""
    short = name.rpartition(".")[2]
    return getattr(import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)

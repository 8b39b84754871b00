"""The file `record.mcap`, written by a thread of its own: whoever puts something in never waits for the disk.

Messages are made by that thread, too: what is put in is how to make them. Chunks are small and go to the system once a
second, so that a run that is cut off loses little; `cell.run.record.repair` closes its file. They are not compressed:
the pictures are, and the rest is little.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cell.base.storage import sync_folder
from cell.run.record.channels import BY_TOPIC, json_schema
from drivers.errors import CellError

FILE = "record.mcap"
NEEDED = ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf")
MOST_WAITING = 20_000
"""Messages that may wait; beyond that new ones are let go, and counted. A second of the busiest wires has a tenth."""
CHUNK_BYTES = 128 * 1024
FLUSH_S, LOOK_S, PATIENCE_S = 1.0, 0.05, 20.0
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
        self._thread.join(PATIENCE_S)
        if self._thread.is_alive():
            self.failure = f"the record was still being written {PATIENCE_S:.0f} s after the end"

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

    def _write(self, out: _Out) -> None:
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

    def _drain(self, out: _Out) -> int:
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


class _Out:
    """The library's writer, and the channels that it knows by now."""

    def __init__(self, stream: Any, facts: dict[str, str]) -> None:
        # Here, in the writer's thread: a job's start does not wait for these packages.
        from mcap.writer import CompressionType, Writer

        self.newest = 0
        self.writer: Any = Writer(
            stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE, enable_data_crcs=True
        )
        self.writer.start(profile="", library="assembly-cell")
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
                self._schemas[name] = self.writer.register_schema(name, "jsonschema", json_schema(name))
        return self._schemas[name]


def message_class(name: str) -> Any:
    """The class of a Foxglove message by its full name."""
    short = name.rpartition(".")[2]
    return getattr(import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)

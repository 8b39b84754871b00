"""The durable record of a run: one SQLite file in the run's folder.

Every row is on the disk when the call that wrote it returns (WAL, synchronous FULL, one transaction a row), so a run
that is killed or loses power can be read up to its last row. Each row has a CRC of its values. Other processes read it
live and put requests into it (`request`), which the runner takes out. Times are seconds since the epoch; durations are
given by the caller.
"""

import json
import math
import sqlite3
import threading
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

Result = TypeVar("Result")

FILE_NAME = "journal.sqlite"
"""The journal's name in a run's folder."""

REQUESTS = ("abort", "pause", "go-on", "confirm", "end-batch")
"""What another process can ask of a run."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS runs (
    id TEXT PRIMARY KEY, started REAL NOT NULL, ended REAL, outcome TEXT, reason TEXT, info TEXT NOT NULL, pid INTEGER,
    crc INTEGER);
CREATE TABLE IF NOT EXISTS steps (
    id INTEGER PRIMARY KEY, run TEXT NOT NULL REFERENCES runs, name TEXT NOT NULL, attempt INTEGER NOT NULL,
    started REAL NOT NULL, ended REAL, state TEXT NOT NULL, duration_s REAL, result TEXT, error TEXT, crc INTEGER);
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY, run TEXT NOT NULL REFERENCES runs, at REAL NOT NULL, kind TEXT NOT NULL, step TEXT,
    data TEXT NOT NULL, crc INTEGER);
CREATE TABLE IF NOT EXISTS requests (
    id INTEGER PRIMARY KEY, at REAL NOT NULL, kind TEXT NOT NULL, reason TEXT NOT NULL, number INTEGER);"""


class JournalError(RuntimeError):
    """The journal's file cannot be opened, read or written."""


@dataclass(frozen=True)
class RunRow:
    """One run; `ended`, `outcome` and `reason` are None while it runs, and for ever if it was killed. `pid` is the
    process that does it, None where an older journal does not tell."""

    id: str
    started: float
    ended: float | None
    outcome: str | None
    reason: str | None
    info: dict[str, Any]
    pid: int | None = None


@dataclass(frozen=True)
class StepRow:
    """One attempt at a step; `state` is running, done or failed."""

    name: str
    attempt: int
    started: float
    ended: float | None
    state: str
    duration_s: float | None
    result: dict[str, object] | None
    error: str | None


@dataclass(frozen=True)
class EventRow:
    """Something that happened, in the order of writing."""

    at: float
    kind: str
    step: str | None
    data: dict[str, Any]


@dataclass(frozen=True)
class RunRequest:
    """Something that another process asked for; `number` is that of the question that a "confirm" answers."""

    kind: str
    reason: str
    number: int | None = None


class Journal:
    """Writes the record of one run into `folder`/journal.sqlite; safe to use from several threads."""

    def __init__(self, folder: Path, run: str, info: Mapping[str, object] | None = None) -> None:
        """Begin the run `run`; `info` is JSON-ready (seed, level, job, hashes …), its "pid" the process that does it.
        `JournalError` if it cannot."""
        self.run = run
        self.path = folder / FILE_NAME
        self._lock = threading.Lock()
        try:
            self._base = sqlite3.connect(self.path, timeout=5.0, isolation_level=None, check_same_thread=False)
            self._base.execute("PRAGMA journal_mode=WAL")
            self._base.execute("PRAGMA synchronous=FULL")
            self._base.executescript(_SCHEMA)
            self._asked = sqlite3.connect(self.path, timeout=1.0, isolation_level=None, check_same_thread=False)
            # What was asked of an earlier run in this file does not concern this one.
            self._taken = int(self._asked.execute("SELECT coalesce(max(id), 0) FROM requests").fetchone()[0])
        except sqlite3.Error as error:
            raise JournalError(f"the journal {self.path} cannot be opened: {error}. Is the folder writable?") from error
        about = dict(info or {})
        pid = about.pop("pid", None)
        self._begun = run, time.time(), None, None, None, _dump(about), pid
        self._begun_steps: dict[int, tuple[str, int, float]] = {}
        self._insert("runs", "id, started, ended, outcome, reason, info, pid", self._begun)

    def step_started(self, name: str, attempt: int) -> int:
        """Record that an attempt (counted from 1) at a step begins; returns the key for `step_ended`."""
        begun = name, attempt, time.time()
        row = *begun, None, "running", None, None, None
        key = self._insert(
            "steps", "run, name, attempt, started, ended, state, duration_s, result, error", (self.run, *row)
        )
        self._begun_steps[key] = begun
        return key

    def step_ended(
        self, key: int, duration_s: float, result: Mapping[str, object] | None = None, error: str | None = None
    ) -> None:
        """Record how the attempt ended: with the summary of its result, or with an error text."""
        summary, state = None if result is None else _dump(result), "done" if error is None else "failed"
        ended = time.time(), state, float(duration_s), summary, None if error is None else _plain(error)
        self._write(
            "UPDATE steps SET ended = ?, state = ?, duration_s = ?, result = ?, error = ?, crc = ? WHERE id = ?",
            *ended, _crc(self.run, *self._begun_steps[key], *ended), key,
        )  # fmt: skip

    def event(self, kind: str, step: str | None = None, data: Mapping[str, object] | None = None) -> None:
        """Record something that happened; `data` is JSON-ready."""
        self._insert("events", "run, at, kind, step, data", (self.run, time.time(), kind, step, _dump(data or {})))

    def run_ended(self, outcome: str, reason: str) -> None:
        """Record the end of the run."""
        run, started, _, _, _, *rest = self._begun
        ended = time.time(), outcome, _plain(reason)
        self._write(
            "UPDATE runs SET ended = ?, outcome = ?, reason = ?, crc = ? WHERE id = ?",
            *ended, _crc(run, started, *ended, *rest), run,
        )  # fmt: skip

    def take_requests(self) -> list[RunRequest]:
        """What other processes have asked for since the last call, oldest first; asked by one thread. It only reads,
        over a connection of its own: a write that stalls keeps nobody from being heard."""
        try:
            rows = self._asked.execute(
                "SELECT id, kind, reason, number FROM requests WHERE id > ? ORDER BY id", (self._taken,)
            ).fetchall()
        except sqlite3.Error as error:
            raise JournalError(f"the journal {self.path} cannot be read: {error}") from error
        if rows:
            self._taken = rows[-1][0]
        return [RunRequest(*row) for _, *row in rows]

    def close(self) -> None:
        """Close the file; the record is complete without it as well."""
        with self._lock:
            self._asked.close()
            self._base.close()

    def _insert(self, table: str, columns: str, values: tuple[object, ...]) -> int:
        marks = ", ".join("?" * (len(values) + 1))
        return self._write(f"INSERT INTO {table} ({columns}, crc) VALUES ({marks})", *values, _crc(*values))

    def _write(self, statement: str, *values: object) -> int:
        with self._lock:
            try:
                return int(self._base.execute(statement, values).lastrowid or 0)
            except sqlite3.Error as error:
                raise JournalError(
                    f"the journal {self.path} cannot be written: {error}. `df -h` tells whether the disk is full"
                ) from error


@dataclass(frozen=True)
class JournalRecord:
    """A journal as it was read: all runs, and the steps and events of the newest."""

    runs: tuple[RunRow, ...]
    steps: tuple[StepRow, ...]
    events: tuple[EventRow, ...]

    @property
    def run(self) -> RunRow:
        """The newest run."""
        return self.runs[-1]

    @property
    def finished(self) -> bool:
        """False for a run that is still going on, or whose process died."""
        return self.run.ended is not None

    @property
    def done(self) -> dict[str, dict[str, object]]:
        """The steps that succeeded, with the summaries of their results, in the order of their end."""
        return {step.name: step.result or {} for step in self.steps if step.state == "done"}


def read(folder: Path, *, whole: bool = False) -> JournalRecord:
    """Read the journal in a run's folder, also while it is being written. With `whole` the file's structure is checked
    as well, which takes longer. `JournalError` if there is none, or one with a row that is not as it was written."""

    def rows(base: sqlite3.Connection) -> JournalRecord:
        if whole and (found := base.execute("PRAGMA quick_check(1)").fetchone()) != ("ok",):
            raise JournalError(f"the journal in {folder} is damaged: {found[0] if found else 'no word of it'}")

        def may(value: object, kind: type[str] | type[float]) -> Any:
            return _is(value, kind, needed=False)

        runs = tuple(
            RunRow(_is(key, str), _is(started, float), may(ended, float), may(outcome, str), reason=may(reason, str),
                   info=_table(info), pid=None if pid is None else int(pid))
            for key, started, ended, outcome, reason, info, pid in _checked(
                base, "runs", "id, started, ended, outcome, reason, info, pid", "ORDER BY rowid"
            )
        )  # fmt: skip
        if not runs:
            raise JournalError(f"the journal in {folder} holds no run")
        own = "WHERE run = ? ORDER BY id", runs[-1].id
        steps = tuple(
            StepRow(_is(name, str), int(attempt), _is(started, float), ended=may(ended, float), state=_is(state, str),
                    duration_s=may(duration, float), result=None if result is None else _table(result),
                    error=may(error, str))
            for _, name, attempt, started, ended, state, duration, result, error in _checked(
                base, "steps", "run, name, attempt, started, ended, state, duration_s, result, error", *own
            )
        )  # fmt: skip
        events = tuple(
            EventRow(_is(at, float), _is(kind, str), may(step, str), _table(data))
            for _, at, kind, step, data in _checked(base, "events", "run, at, kind, step, data", *own)
        )
        return JournalRecord(runs, steps, events)

    try:
        return _in_existing(folder, rows)
    except (ValueError, TypeError, RecursionError, OverflowError, MemoryError) as error:
        raise JournalError(f"the journal in {folder} is damaged: {type(error).__name__}: {error}") from error


def _checked(base: sqlite3.Connection, table: str, columns: str, rest: str, *values: object) -> list[tuple[Any, ...]]:
    """The rows of a table; `JournalError` for one that does not fit its CRC. Journals of older versions have none."""
    there = {row[1] for row in base.execute(f"PRAGMA table_info({table})")}
    # Older ones do not tell the process either.
    wanted = ", ".join("NULL" if name == "pid" and name not in there else name for name in columns.split(", "))
    if "crc" not in there:
        return base.execute(f"SELECT {wanted} FROM {table} {rest}", values).fetchall()
    rows = base.execute(f"SELECT {wanted}, crc FROM {table} {rest}", values).fetchall()
    for number, (*row, crc) in enumerate(rows, 1):
        if crc != _crc(*row):
            raise JournalError(f"row {number} of its {table} is not as it was written: {str(row)[:200]}")
    return [tuple(row) for *row, _ in rows]


def _crc(*values: object) -> int:
    """Of a row as SQLite gives it back."""
    return zlib.crc32(json.dumps(values, default=str).encode())


def _is(value: object, kind: type[str] | type[float], *, needed: bool = True) -> Any:
    """The value; `ValueError` where it is no text or no number, or missing."""
    if value is None and not needed:
        return None
    if isinstance(value, int) and kind is float:
        value = float(value)
    if not isinstance(value, kind) or (isinstance(value, float) and not math.isfinite(value)):
        raise ValueError(f"{str(value)[:40]!r} is no {'text' if kind is str else 'number'}")
    return value


def _table(text: object) -> dict[str, object]:
    data = json.loads(_is(text, str))
    if not isinstance(data, dict):
        raise ValueError(f"{str(data)[:40]} is no table")
    return data


def request(folder: Path, kind: str, reason: str, number: int | None = None) -> None:
    """Ask the run in `folder` for `kind`, one of `REQUESTS`; the runner sees it within a fraction of a second. A
    "confirm" has the `number` of the question that it answers: it counts for no other."""
    if kind not in REQUESTS:
        raise ValueError(f"request '{kind}' is unknown; a run takes {', '.join(REQUESTS)}")
    if kind == "confirm" and number is None:
        raise ValueError("a confirmation needs the number of its question")
    # Bytes that are no text would keep it from being written.
    reason = reason.encode(errors="backslashreplace").decode()

    def write(base: sqlite3.Connection) -> None:
        base.execute(
            "INSERT INTO requests (at, kind, reason, number) VALUES (?, ?, ?, ?)", (time.time(), kind, reason, number)
        )

    _in_existing(folder, write)


def _in_existing(folder: Path, use: Callable[[sqlite3.Connection], Result]) -> Result:
    path = folder / FILE_NAME
    if not path.exists():
        raise JournalError(f"there is no journal {path}; see that the folder is that of a run")
    try:
        base = sqlite3.connect(path, timeout=5.0, isolation_level=None)
        try:
            return use(base)
        finally:
            base.close()
    except sqlite3.Error as error:
        raise JournalError(f"the journal {path} cannot be used: {error}") from error


def _plain(text: str) -> str:
    """A name of a file may hold bytes that are no text."""
    return text.encode(errors="backslashreplace").decode()


def _dump(data: Mapping[str, object]) -> str:
    return json.dumps(dict(data), default=str)

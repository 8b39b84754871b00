"""The durable record of a run: one SQLite file in the run's folder.

Every row is on the disk when the call that wrote it returns (WAL, synchronous FULL, one transaction a row), so a run
that is killed or loses power can be read up to its last row. Other processes read it live and put requests into it
(`request`), which the runner takes out. Times are seconds since the epoch; durations are given by the caller.
"""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

Result = TypeVar("Result")

FILE_NAME = "journal.sqlite"
"""The journal's name in a run's folder."""

REQUESTS = ("abort", "pause", "go-on", "confirm")
"""What another process can ask of a run."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS runs (
    id TEXT PRIMARY KEY, started REAL NOT NULL, ended REAL, outcome TEXT, reason TEXT, info TEXT NOT NULL, pid INTEGER);
CREATE TABLE IF NOT EXISTS steps (
    id INTEGER PRIMARY KEY, run TEXT NOT NULL REFERENCES runs, name TEXT NOT NULL, attempt INTEGER NOT NULL,
    started REAL NOT NULL, ended REAL, state TEXT NOT NULL, duration_s REAL, result TEXT, error TEXT);
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY, run TEXT NOT NULL REFERENCES runs, at REAL NOT NULL, kind TEXT NOT NULL, step TEXT,
    data TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS requests (
    id INTEGER PRIMARY KEY, at REAL NOT NULL, kind TEXT NOT NULL, reason TEXT NOT NULL, number INTEGER);
"""


class JournalError(RuntimeError):
    """The journal's file cannot be opened, read or written."""


@dataclass(frozen=True)
class RunRow:
    """One run; `ended`, `outcome` and `reason` are None while it runs, and for ever if it was killed.

    `pid` is the process that does it, None where an older journal does not tell.
    """

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
    result: dict[str, Any] | None
    error: str | None


@dataclass(frozen=True)
class EventRow:
    """Something that happened, in the order of writing."""

    at: float
    kind: str
    step: str | None
    data: dict[str, Any]


@dataclass(frozen=True)
class Request:
    """Something that another process asked for; `number` is that of the question that a "confirm" answers."""

    kind: str
    reason: str
    number: int | None = None


class Journal:
    """Writes the record of one run into `folder`/journal.sqlite; safe to use from several threads."""

    def __init__(self, folder: Path, run: str, info: Mapping[str, object] | None = None) -> None:
        """Begin the run `run`; `info` is JSON-ready (seed, level, job, hashes …), its "pid" the process that does it.

        `JournalError` if it cannot.
        """
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
        self._write(
            "INSERT INTO runs (id, started, info, pid) VALUES (?, ?, ?, ?)", run, time.time(), _dump(about), pid
        )

    def step_started(self, name: str, attempt: int) -> int:
        """Record that an attempt (counted from 1) at a step begins; returns the key for `step_ended`."""
        return self._write(
            "INSERT INTO steps (run, name, attempt, started, state) VALUES (?, ?, ?, ?, 'running')",
            self.run, name, attempt, time.time(),
        )  # fmt: skip

    def step_ended(
        self, key: int, duration_s: float, result: Mapping[str, object] | None = None, error: str | None = None
    ) -> None:
        """Record how the attempt ended: with the summary of its result, or with an error text."""
        self._write(
            "UPDATE steps SET ended = ?, state = ?, duration_s = ?, result = ?, error = ? WHERE id = ?",
            time.time(), "done" if error is None else "failed", duration_s,
            None if result is None else _dump(result), error, key,
        )  # fmt: skip

    def event(self, kind: str, step: str | None = None, data: Mapping[str, object] | None = None) -> None:
        """Record something that happened; `data` is JSON-ready."""
        self._write(
            "INSERT INTO events (run, at, kind, step, data) VALUES (?, ?, ?, ?, ?)",
            self.run, time.time(), kind, step, _dump(data or {}),
        )  # fmt: skip

    def run_ended(self, outcome: str, reason: str) -> None:
        """Record the end of the run."""
        self._write(
            "UPDATE runs SET ended = ?, outcome = ?, reason = ? WHERE id = ?", time.time(), outcome, reason, self.run
        )

    def take_requests(self) -> list[Request]:
        """What other processes have asked for since the last call, oldest first; asked by one thread.

        It only reads, over a connection of its own: a write that stalls keeps nobody from being heard.
        """
        try:
            rows = self._asked.execute(
                "SELECT id, kind, reason, number FROM requests WHERE id > ? ORDER BY id", (self._taken,)
            ).fetchall()
        except sqlite3.Error as error:
            raise JournalError(f"the journal {self.path} cannot be read: {error}") from error
        if rows:
            self._taken = rows[-1][0]
        return [Request(*row) for _, *row in rows]

    def close(self) -> None:
        """Close the file; the record is complete without it as well."""
        with self._lock:
            self._asked.close()
            self._base.close()

    def _write(self, statement: str, *values: object) -> int:
        with self._lock:
            try:
                return int(self._base.execute(statement, values).lastrowid or 0)
            except sqlite3.Error as error:
                raise JournalError(f"the journal {self.path} cannot be written: {error}. Is the disk full?") from error


@dataclass(frozen=True)
class Record:
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
    def done(self) -> dict[str, dict[str, Any]]:
        """The steps that succeeded, with the summaries of their results, in the order of their end."""
        return {step.name: step.result or {} for step in self.steps if step.state == "done"}


def read(folder: Path) -> Record:
    """Read the journal in a run's folder, also while it is being written; `JournalError` if there is none."""

    def rows(base: sqlite3.Connection) -> Record:
        columns = "id, started, ended, outcome, reason, info, " + ("pid" if _tells_pid(base) else "NULL")
        runs = tuple(
            RunRow(key, started, ended, outcome, reason, json.loads(info), pid)
            for key, started, ended, outcome, reason, info, pid in base.execute(
                f"SELECT {columns} FROM runs ORDER BY rowid"
            )
        )
        if not runs:
            raise JournalError(f"the journal in {folder} holds no run")
        steps = base.execute(
            "SELECT name, attempt, started, ended, state, duration_s, result, error FROM steps WHERE run = ? "
            "ORDER BY id", (runs[-1].id,),
        )  # fmt: skip
        events = base.execute("SELECT at, kind, step, data FROM events WHERE run = ? ORDER BY id", (runs[-1].id,))
        return Record(
            runs,
            tuple(
                StepRow(
                    name,
                    attempt,
                    started,
                    ended,
                    state,
                    duration,
                    None if result is None else json.loads(result),
                    error,
                )
                for name, attempt, started, ended, state, duration, result, error in steps
            ),
            tuple(EventRow(at, kind, step, json.loads(data)) for at, kind, step, data in events),
        )

    return _in_existing(folder, rows)


def _tells_pid(base: sqlite3.Connection) -> bool:
    return "pid" in (row[1] for row in base.execute("PRAGMA table_info(runs)"))


def request(folder: Path, kind: str, reason: str, number: int | None = None) -> None:
    """Ask the run in `folder` for `kind`, one of `REQUESTS`; the runner sees it within a fraction of a second.

    A "confirm" has the `number` of the question that it answers: it counts for no other.
    """
    if kind not in REQUESTS:
        raise ValueError(f"request '{kind}' is unknown; a run takes {', '.join(REQUESTS)}")

    if kind == "confirm" and number is None:
        raise ValueError("a confirmation needs the number of its question")

    def write(base: sqlite3.Connection) -> None:
        base.execute(
            "INSERT INTO requests (at, kind, reason, number) VALUES (?, ?, ?, ?)", (time.time(), kind, reason, number)
        )

    _in_existing(folder, write)


def _in_existing(folder: Path, use: Callable[[sqlite3.Connection], Result]) -> Result:
    path = folder / FILE_NAME
    if not path.exists():
        raise JournalError(f"there is no journal {path}. Is {folder} a run's folder?")
    try:
        base = sqlite3.connect(path, timeout=5.0, isolation_level=None)
        try:
            return use(base)
        finally:
            base.close()
    except sqlite3.Error as error:
        raise JournalError(f"the journal {path} cannot be used: {error}") from error


def _dump(data: Mapping[str, object]) -> str:
    return json.dumps(dict(data), default=str)

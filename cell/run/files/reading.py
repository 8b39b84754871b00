"""What a run's folder tells afterwards, or while it is going on: its report, or what the journal knows so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from cell.base.storage import EditedError, read_json
from cell.run.files.folder import REPORT, when
from drivers.errors import CellError, ConfigError
from statemachine.journal import JournalError, JournalRecord, read


def read_report(folder: Path) -> dict[str, Any]:
    """The report of a run; for a run that has none yet, what the journal tells.

    Raises `CellError` for a report or a journal that cannot be read, `ConfigError` where there is neither.
    """
    path = folder / REPORT
    if not path.exists():
        return _from_journal(folder)
    try:
        report = read_json(path).require()
    except EditedError as error:
        raise CellError(f"{path}: {error}; it is not what the run reported. The journal is beside it") from error
    except (OSError, ValueError) as error:
        raise CellError(
            f"{path} cannot be read ({error}): it was cut off or is none of ours; what else is left of the run lies "
            "beside it"
        ) from error
    if not isinstance(report.get("outcome"), str) or not all(
        _rows(report.get(key)) for key in ("steps", "measured", "faults")
    ):  # fmt: skip
        raise CellError(f"{path} is not the report of a run: it does not tell an outcome, or not as a report does")
    return report


def _rows(value: object) -> bool:
    return value is None or (isinstance(value, list) and all(isinstance(row, dict) for row in value))


def _from_journal(folder: Path) -> dict[str, Any]:
    try:
        record = read(folder)
    except JournalError as error:
        raise ConfigError(f"{folder} holds neither a report nor a journal that can be read: {error}") from error
    except (ValueError, TypeError) as error:
        raise CellError(f"{folder} holds a journal that is none of ours: {error}") from error
    run = record.run
    waits = _awaited(record)
    going = "the run is still going on, or its process died" if waits is None else f"waits for a person, {waits}"
    part = [event.data["part"] for event in record.events if event.kind == "note" and "part" in event.data]
    steps: dict[str, dict[str, Any]] = {}
    for row in record.steps:
        before = steps.get(row.name, {"duration_s": 0.0, "wall_s": 0.0, "retries": -1})
        steps[row.name] = {
            "name": row.name,
            "state": row.state,
            "duration_s": before["duration_s"] + (row.duration_s or 0.0),
            "wall_s": before["wall_s"] + max(0.0, (row.ended or row.started) - row.started),
            "retries": before["retries"] + 1,
        }
    return {
        "run": folder.name,
        "kind": "job",
        "outcome": run.outcome or "not ended",
        "reason": run.reason or going,
        "started": when(run.started),
        "ended": None if run.ended is None else when(run.ended),
        "wall_s": None if run.ended is None else round(run.ended - run.started, 2),
        "pid": run.pid,
        "steps": list(steps.values()),
        **({"part": part[-1]} if part else {}),
        **run.info,
    }


def run_row(folder: Path) -> dict[str, Any]:
    """A run in a few facts, for a list; one that cannot be read has the outcome "unreadable" and says why."""
    try:
        report = read_report(folder)
    except (CellError, OSError) as error:
        report = {"outcome": "unreadable", "reason": str(error)}
    keys = ("outcome", "job", "simulated", "seed", "level", "reason", "started")
    kind = report.get("kind", "job") if report["outcome"] != "unreadable" else None
    return {
        "run": folder.name,
        **{key: report.get(key) for key in keys},
        "kind": kind,
        "duration_s": wall_seconds(report),
    }


def wall_seconds(report: Mapping[str, Any]) -> float | None:
    """How long a run took on the wall, by its dates where the report does not say; None while it is not known."""
    if report.get("wall_s") is not None:
        return float(report["wall_s"])
    try:
        begun, ended = (datetime.fromisoformat(str(report[key])) for key in ("started", "ended"))
    except (KeyError, ValueError):
        return None
    return (ended - begun).total_seconds()


@dataclass(frozen=True)
class Question:
    """What a person has to confirm before a run goes on; each question of a run has a number of its own."""

    number: int
    reason: str

    def __str__(self) -> str:
        return f"question {self.number}: {self.reason}"


def awaited_word(folder: Path) -> Question | None:
    """What a person has to confirm now before the run in `folder` goes on; None when it waits for nobody."""
    try:
        return _awaited(read(folder))
    except JournalError as error:
        raise ConfigError(str(error)) from error


def _awaited(record: JournalRecord) -> Question | None:
    kinds = ("confirm_needed", "confirmed", "state")
    last = next((event for event in reversed(record.events) if event.kind in kinds), None)
    if last is None or last.kind != "confirm_needed":
        return None
    return Question(int(last.data.get("number", 0)), str(last.data["reason"]))

"""Run folders `runs/<time>-<id>/`: make one, find one, and read its report or what its journal knows so far.

Every module has a logger of its own, `logging.getLogger(__name__)`; they write to `run.log` in the folder and to the
console. Nothing but the command line prints.
"""

import logging
import re
import secrets
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cell.base.storage import EditedError, read_json
from drivers.errors import CellError, ConfigError
from statemachine.journal import FILE_NAME as JOURNAL
from statemachine.journal import JournalError, JournalRecord, read

DISTRIBUTION, REPORT = "assembly-cell", "report.json"
Report = Mapping[str, Any]
"""What a run's `report.json` holds, or as much of it as its journal tells; docs/reference/report.md has its keys."""
_NAME = re.compile(r"\d{8}T\d{6}-[0-9a-f]{4}")
_STAMP = "%Y%m%dT%H%M%S"


def new_run(root: Path) -> Path:
    """Create the folder of a new run below `root`, named after the local time, or after the newest that is there."""
    root.mkdir(parents=True, exist_ok=True)
    while True:
        # Summer time ends, and clocks are set back.
        now, before = time.strftime(_STAMP), [run.name.partition("-")[0] for run in list_runs(root)[-1:]]
        later = [(datetime.strptime(stamp, _STAMP) + timedelta(seconds=1)).strftime(_STAMP) for stamp in before]
        folder = root / f"{max([now, *later])}-{secrets.token_hex(2)}"
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder


@contextmanager
def new_folder(root: Path) -> Iterator[Path]:
    """The folder of a new run, which goes again, lest it be taken for the newest, where it cannot be written into."""
    folder = None
    try:
        folder = new_run(root)
        yield folder
    except (OSError, JournalError) as error:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        raise CellError(
            f"no run can be recorded in {root}: {error}. `df -h` tells whether the disk is full, `ls -ld` who may write"
        ) from error


def list_runs(root: Path) -> list[Path]:
    """All run folders below `root`, oldest first."""
    if not root.is_dir():
        return []
    return sorted(entry for entry in root.iterdir() if entry.is_dir() and _NAME.fullmatch(entry.name))


def find_run(root: Path, name: str | None, kind: str | None = None) -> Path:
    """A run by its folder, name or id; without a name the newest, of one kind if given. Raises `ConfigError`."""
    if name is not None and (Path(name) / "journal.sqlite").exists():
        return Path(name).resolve()
    runs = list_runs(root)
    if name is None:
        matching = [run for run in runs if kind is None or _info(run).get("kind", "job") == kind][-1:]
    else:
        matching = [run for run in runs if run.name == name or run.name.endswith(f"-{name}")]
    if not matching:
        wanted = f"no {kind or 'run'} at all" if name is None else f"no run {name}"
        raise ConfigError(f"{wanted} in {root}; `cell runs` lists them, -c names the cell.toml of another cell")
    return matching[-1]


def find_going(root: Path, name: str | None) -> Path:
    """The run that is going on below `root`, by name or the only one; `ConfigError` that says what there is instead."""
    if name is not None:
        folder = find_run(root, name)
        if not listens(folder):
            raise ConfigError(f"run {folder.name} has ended already, or its process died; nothing is going on there")
        return folder
    going = [folder for folder in list_runs(root) if listens(folder)]
    if len(going) == 1:
        return going[0]
    if going:
        listed = ", ".join(f"{folder.name} ({_info(folder).get('kind', 'job')})" for folder in going)
        raise ConfigError(f"more than one is going on in {root}: {listed}; name the one that you mean")
    raise ConfigError(
        f"nothing is going on in {root}: no run, calibration, verification, homing or jog. Run this in the folder of "
        "the cell that moves, or name its configuration with -c; `cell runs` lists what was run"
    )


def is_going(folder: Path) -> bool:
    """Whether a run has not ended and its process lives."""
    try:
        run = read(folder).run
    except (JournalError, ValueError, TypeError):
        return False
    return run.ended is None and _lives(run.pid, folder)


def listens(folder: Path) -> bool:
    """Whether a run is going on that takes requests: nobody works in a time of maintenance, it is only recorded."""
    return is_going(folder) and _info(folder).get("kind", "job") != "maintenance"


def _lives(pid: object, folder: Path) -> bool:
    """Whether the process `pid` lives and has the journal in `folder` open. Another user's does not show its files."""
    if not isinstance(pid, int):
        return False
    process, journal = Path(f"/proc/{pid}"), (folder / JOURNAL).resolve()
    try:
        if (process / "stat").read_text().rpartition(")")[2].split()[0] == "Z":
            return False
        for file in (process / "fd").iterdir():
            # It closes others meanwhile.
            with suppress(FileNotFoundError):
                if file.readlink() == journal:
                    return True
        return False
    except PermissionError:
        return True
    except OSError:
        return False


def _info(folder: Path) -> dict[str, object]:
    try:
        return read(folder).run.info
    except (JournalError, ValueError, TypeError):
        return {}


def release() -> str:
    """The version of the installed distribution; "not installed" when it runs from a checkout alone."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return "not installed"


def when(seconds: float) -> str:
    """A time since the epoch as ISO 8601, local, with its offset."""
    return time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(seconds))


def timeless(report: dict[str, Any]) -> dict[str, Any]:
    """A report as it is written: on the virtual clock without what differs each time, durations on the wall and the
    process. The same seed then gives the same report, but for the run's name and its dates."""
    if report.get("clock") != "virtual":
        return report
    steps = [{**step, "wall_s": None} for step in report["steps"]] if "steps" in report else None
    return {**report, "wall_s": None, "pid": None, **({} if steps is None else {"steps": steps})}


def read_report(folder: Path) -> dict[str, Any]:
    """The report of a run; for a run that has none yet, what the journal tells. Raises `CellError` for a report or a
    journal that cannot be read, `ConfigError` where there is neither."""
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
    tables = [table for key in ("steps", "measured", "faults") if (table := report.get(key)) is not None]
    rows = all(isinstance(table, list) and all(isinstance(row, dict) for row in table) for table in tables)
    if not rows or not isinstance(report.get("outcome"), str):
        raise CellError(f"{path} is not the report of a run: it does not tell an outcome, or not as a report does")
    return report


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
            "name": row.name, "state": row.state, "duration_s": before["duration_s"] + (row.duration_s or 0.0),
            "wall_s": before["wall_s"] + max(0.0, (row.ended or row.started) - row.started),
            "retries": before["retries"] + 1,
        }  # fmt: skip
    return {
        "run": folder.name, "kind": "job", "outcome": run.outcome or "not ended", "reason": run.reason or going,
        "started": when(run.started), "ended": None if run.ended is None else when(run.ended),
        "wall_s": None if run.ended is None else round(run.ended - run.started, 2), "pid": run.pid,
        "steps": list(steps.values()), **({"part": part[-1]} if part else {}), **run.info,
    }  # fmt: skip


def run_row(folder: Path) -> dict[str, object]:
    """A run in a few facts, for a list; one that cannot be read has the outcome "unreadable" and says why."""
    try:
        report = read_report(folder)
    except (CellError, OSError) as error:
        report = {"outcome": "unreadable", "reason": str(error)}
    keys = ("outcome", "job", "simulated", "seed", "level", "reason", "started")
    kind = report.get("kind", "job") if report["outcome"] != "unreadable" else None
    return {
        "run": folder.name, **{key: report.get(key) for key in keys}, "kind": kind, "duration_s": wall_seconds(report),
    }  # fmt: skip


def wall_seconds(report: Report) -> float | None:
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


FILE_NAME = "run.log"
PACKAGES = ("cell", "drivers", "statemachine")
_FORMAT = "%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s"
_DATE = "%Y-%m-%dT%H:%M:%S"


class _RunLog(logging.FileHandler):
    """A log that cannot be written, on a full disk for one, ends nothing and says nothing in what a person reads."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Leave the line out."""

    def close(self) -> None:
        """What cannot be written any more is left out."""
        with suppress(OSError):
            super().close()


@contextmanager
def run_log(folder: Path) -> Iterator[None]:
    """While the context is open, what the modules log goes to `run.log` in `folder` as well."""
    handler = _RunLog(folder / FILE_NAME, encoding="utf-8", delay=True)
    handler.setFormatter(logging.Formatter(_FORMAT, _DATE))
    loggers = [logging.getLogger(name) for name in PACKAGES]
    for logger in loggers:
        if logger.level == logging.NOTSET:
            logger.setLevel(logging.INFO)
        logger.addHandler(handler)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
        handler.close()


def console_log(verbosity: int) -> None:
    """Show warnings on standard error; what happens with `verbosity` 1, everything with 2."""
    handler = logging.StreamHandler()
    handler.setLevel({0: logging.WARNING, 1: logging.INFO}.get(verbosity, logging.DEBUG))
    handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
    for name in PACKAGES:
        logger = logging.getLogger(name)
        logger.addHandler(handler)
        logger.setLevel(logging.DEBUG if verbosity > 1 else logging.INFO)

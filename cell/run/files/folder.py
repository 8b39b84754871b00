"""Run folders `runs/<time>-<id>/`: make one, write into it, find one by name or the one that is going on."""

from __future__ import annotations

import os
import re
import secrets
import time
from pathlib import Path
from typing import Any

from cell.base.storage import write_json as write_json
from drivers.errors import ConfigError
from statemachine.journal import JournalError, read

REPORT = "report.json"
_NAME = re.compile(r"\d{8}T\d{6}-[0-9a-f]{4}")


def new_run(root: Path) -> Path:
    """Create the folder of a new run below `root`."""
    root.mkdir(parents=True, exist_ok=True)
    while True:
        folder = root / f"{time.strftime('%Y%m%dT%H%M%S')}-{secrets.token_hex(2)}"
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder


def list_runs(root: Path) -> list[Path]:
    """All run folders below `root`, oldest first."""
    if not root.is_dir():
        return []
    return sorted(entry for entry in root.iterdir() if entry.is_dir() and _NAME.fullmatch(entry.name))


def find_run(root: Path, name: str | None, kind: str | None = None) -> Path:
    """A run by its folder, name or id; without a name the newest, of one kind if given. Raises `ConfigError`."""
    if name is not None and (Path(name) / "journal.sqlite").exists():
        return Path(name)
    runs = list_runs(root)
    if name is None:
        matching = [run for run in runs if kind is None or _info(run).get("kind", "job") == kind][-1:]
    else:
        matching = [run for run in runs if run.name == name or run.name.endswith(f"-{name}")]
    if not matching:
        wanted = f"no {kind or 'run'} at all" if name is None else f"no run {name}"
        raise ConfigError(f"{wanted} in {root}; `cell runs` lists them")
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
    return run.ended is None and _lives(run.pid, run.started)


def listens(folder: Path) -> bool:
    """Whether a run is going on that takes requests: nobody works in a time of maintenance, it is only recorded."""
    return is_going(folder) and _info(folder).get("kind", "job") != "maintenance"


def _lives(pid: object, since: float) -> bool:
    """Whether the process `pid` lives and is the one that did at `since`, seconds since the epoch."""
    if not isinstance(pid, int):
        return False
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks = float(words[19]) / os.sysconf("SC_CLK_TCK")
        begun = time.time() - float(Path("/proc/uptime").read_text().split()[0]) + ticks
    except (OSError, ValueError, IndexError):
        return False
    return words[0] != "Z" and begun < since + 1.0


def _info(folder: Path) -> dict[str, Any]:
    try:
        return read(folder).run.info
    except (JournalError, ValueError, TypeError):
        return {}


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

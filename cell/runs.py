"""Run folders `runs/<time>-<id>/`, and the lock by which one process at a time holds a cell."""

from __future__ import annotations

import fcntl
import json
import os
import re
import secrets
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from cell.config import CellConfig
from drivers.errors import ConfigError, InterlockError
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


def find_run(root: Path, name: str | None) -> Path:
    """A run by its folder, its name or its id; without a name the newest. Raises `ConfigError`."""
    if name is not None and (Path(name) / "journal.sqlite").exists():
        return Path(name)
    runs = list_runs(root)
    matching = runs[-1:] if name is None else [run for run in runs if run.name == name or run.name.endswith(f"-{name}")]
    if not matching:
        wanted = "no run at all" if name is None else f"no run {name}"
        raise ConfigError(f"{wanted} in {root}; `cell runs` lists them")
    return matching[-1]


def read_report(folder: Path) -> dict[str, Any]:
    """The report of a run; for a run that has none yet, what the journal tells."""
    path = folder / REPORT
    if path.exists():
        report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return report
    try:
        record = read(folder)
    except JournalError as error:
        raise ConfigError(f"{folder} holds neither a report nor a journal: {error}") from error
    return {
        "outcome": record.run.outcome or "not ended",
        "reason": record.run.reason or "the run is still going on, or its process died",
        "steps": [{"name": step.name, "state": step.state, "duration_s": step.duration_s} for step in record.steps],
        **record.run.info,
    }


def write_json(path: Path, data: Any) -> None:
    """Write JSON so that a reader finds the old file or the new one, never half of one."""
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    with temporary.open("w", encoding="utf-8") as file:
        json.dump(data, file, indent=2)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


class CellLock:
    """Held by the process that has the cell's devices open; the kernel drops it when that process ends.

    Two cells are told apart by their devices' addresses, so a run against one cell does not block another.
    """

    def __init__(self, config: CellConfig) -> None:
        name = re.sub(r"[^A-Za-z0-9]+", "-", f"{config.arm.address}-{config.rail.url}")
        folder = Path(os.environ.get("XDG_RUNTIME_DIR", "/tmp"))
        self.path = folder / f"cell-{os.getuid()}-{name}.lock"
        self._name = config.cell.name
        self._file = -1

    def __enter__(self) -> CellLock:
        while True:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o600)
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = os.pread(self._file, 64, 0).decode(errors="replace").strip() or "unknown"
                os.close(self._file)
                raise InterlockError(
                    self._name, f"the cell is held by process {holder}; wait for its end, or end it with `cell abort`"
                ) from None
            if self._is_current():
                break
            os.close(self._file)  # the holder before removed the file after it was opened here
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, str(os.getpid()).encode(), 0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._file >= 0:
            self.path.unlink(missing_ok=True)
            os.close(self._file)
            self._file = -1

    def _is_current(self) -> bool:
        try:
            return os.path.samestat(os.fstat(self._file), self.path.stat())
        except FileNotFoundError:
            return False

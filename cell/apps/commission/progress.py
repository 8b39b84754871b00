"""Where a commissioning stands, in a file: each check's result with what it rested on, so that one can go on later.

A result counts as long as nothing that it rests on has changed: the keys of the configuration that its check names, the
results that it needs, and which cell it is. Findings are kept for the protocol when they have been mended, too.
"""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import Any

from cell.apps.commission.check import CheckVerdict, CommissionCheck, Result
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.run.files.folder import write_json
from drivers.errors import ConfigError

FILE = "progress.json"
VERSION = 1


class Progress:
    """The results so far, in `folder`; `cell` says which cell they are of (name, simulated or not, which world)."""

    def __init__(self, folder: Path, cell: dict[str, Any], job: Job) -> None:
        """Read what is there; `ConfigError` when that is none. `job` is the key "job" of checks."""
        self.folder = folder
        self.cell = cell
        self.work_for(job)
        self._file = folder / FILE
        self._data: dict[str, Any] = {"version": VERSION, "results": {}, "mended": []}
        if self._file.exists():
            try:
                self._data = json.loads(self._file.read_text(encoding="utf-8"))
                if self._data["version"] != VERSION:
                    raise ValueError(f"version {self._data['version']}, this program writes {VERSION}")
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise ConfigError(
                    f"{self._file} is no record of a commissioning: {error}; move it away to begin anew"
                ) from error

    def work_for(self, job: Job) -> None:
        """The job as its file has it now: what rests on another text of it is stale."""
        self._job = job.model_dump(mode="json")

    def result(self, name: str) -> dict[str, Any] | None:
        """The stored result of a check, whether it still counts or not."""
        stored: dict[str, Any] | None = self._data["results"].get(name)
        return stored

    @property
    def mended(self) -> list[dict[str, Any]]:
        """Findings that were written into the configuration, oldest first, each with its check and time."""
        found: list[dict[str, Any]] = self._data["mended"]
        return found

    def standing(self, check: CommissionCheck, config: CellConfig) -> str:
        """How it stands: "open" (never done), "stale" (what it rests on has changed), or its verdict."""
        stored = self.result(check.name)
        if stored is None:
            return "open"
        if stored["rests_on"] != self._rests_on(check, config):
            return "stale"
        return str(stored["verdict"])

    def keep(self, check: CommissionCheck, config: CellConfig, result: Result, seconds: float, run: str) -> None:
        """Store a result, and write the file."""
        stored = {
            **result.as_dict(), "when": time.strftime("%Y-%m-%d %H:%M:%S"), "seconds": round(seconds, 1), "run": run,
            "rests_on": self._rests_on(check, config),
        }  # fmt: skip
        self._data["results"][check.name] = stored
        self._write()

    def keep_mended(self, check: CommissionCheck, finding: dict[str, Any], backup: str) -> None:
        """Store that a finding was written into the configuration, and where its old text is."""
        entry = {"check": check.name, "when": time.strftime("%Y-%m-%d %H:%M:%S"), "backup": backup, **finding}
        self._data["mended"].append(entry)
        self._write()

    def forget(self, names: list[str]) -> None:
        """These checks are to be done again."""
        for name in names:
            self._data["results"].pop(name, None)
        self._write()

    def _rests_on(self, check: CommissionCheck, config: CellConfig) -> str:
        """A hash of all that the result of a check rests on."""
        dumped = {**config.model_dump(mode="json"), "job": self._job}
        before = {name: (self.result(name) or {}).get("rests_on") for name in check.needs}
        parts = {"cell": self.cell, "keys": {key: _at(dumped, key) for key in check.keys}, "needs": before}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def _write(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self._file, self._data)


def done_well(standing: str) -> bool:
    """Whether a check that stands so needs not be done again."""
    return standing == CheckVerdict.GOOD


def _at(tables: dict[str, Any], key: str) -> Any:
    value: Any = tables
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value

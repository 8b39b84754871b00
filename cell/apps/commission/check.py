"""What a check of the commissioning is, what it leaves, and the record of all that were done, with its protocol page.

A check measures. It never compares two files: what it says of the configuration, the devices and the pictures told it.
A result counts as long as nothing that it rests on has changed: the keys of the configuration that its check names, the
results that it needs, and which cell it is.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cell.base.storage import write_json
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.run.folder import release
from cell.run.report.page import render
from drivers.errors import CellError, ConfigError
from drivers.interfaces import Reading

if TYPE_CHECKING:
    from cell.apps.commission.workplace import CommissionWorkplace


class CheckVerdict(StrEnum):
    """How a check ended."""

    GOOD = "good"
    WRONG = "wrong"
    """Something was measured that is not as it should be; the findings, or the figures, say what."""
    FAILED = "failed"
    """It could not be measured; the notes say why and what to do."""
    DECLINED = "declined"


@dataclass(frozen=True)
class Finding:
    """Something that is not as the configuration has it.

    `name` is its keys in cell.toml; `told` what stands there, `found` what was measured, both in words with units.
    `write` are the keys and the values, as TOML, that would be right; empty where a person has to act. `write_job` are
    the same of the job's file. `remedy` is what to do.
    """

    name: str
    what: str
    told: str
    found: str
    remedy: str
    write: dict[str, str]
    write_job: dict[str, str]

    def __str__(self) -> str:
        return f"{self.name}: {self.what}; configured {self.told}, measured {self.found}. {self.remedy}"


@dataclass
class Result:
    """What a check has found out; filled while it goes on, so that what was measured before a failure is kept."""

    verdict: CheckVerdict = CheckVerdict.GOOD
    readings: list[Reading] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)

    def measure(
        self, what: str, value: float, unit: str, *, least: float | None = None, most: float | None = None,
        remedy: str = "",
    ) -> None:  # fmt: skip
        """Note a figure with its limits; one outside makes the check wrong."""
        reading = Reading(what, float(value), unit, least=least, most=most, remedy=remedy)
        self.readings.append(reading)
        if not reading.ok:
            self.verdict = CheckVerdict.WRONG
            shown = f"{what}: {value:.4g} {unit}".strip() + f", allowed {bounds(reading)} {unit}".rstrip()
            self.notes.append(f"{shown}. {remedy}".strip())

    def require(self, what: str, so: bool, remedy: str = "") -> None:
        """Note whether something is as it has to be."""
        self.measure(what, float(so), "", least=1.0, remedy=remedy)

    def find(
        self, name: str, what: str, told: str, found: str, remedy: str, *, write: dict[str, str] | None = None,
        write_job: dict[str, str] | None = None,
    ) -> None:  # fmt: skip
        """Note a `Finding`; the check is wrong then."""
        self.findings.append(Finding(name, what, told, found, remedy, write=write or {}, write_job=write_job or {}))
        self.verdict = CheckVerdict.WRONG

    def as_dict(self) -> dict[str, object]:
        """JSON-ready."""
        return {
            "verdict": self.verdict.value, "readings": [{**asdict(row), "ok": row.ok} for row in self.readings],
            "findings": [asdict(finding) for finding in self.findings], "notes": self.notes, "pictures": self.pictures,
        }  # fmt: skip


class CommissionCheck(NamedTuple):
    """One check: `moves` what, how `far`, how `fast`; `limit` what has to hold; `keys` of the configuration that it
    rests on (tables, or dotted keys); `needs` the checks that have to be good before; `work` does it.

    A check that is not `recorded` begins runs of its own, or stops the cell.
    """

    name: str
    title: str
    moves: str
    far: str
    fast: str
    limit: str
    keys: tuple[str, ...]
    needs: tuple[str, ...]
    work: Callable[[CommissionWorkplace, Result], None]
    recorded: bool = True


def bounds(reading: Reading) -> str:
    """The limits of a figure in words, without its unit."""
    match reading.least, reading.most:
        case None, None:
            return ""
        case None, most:
            return f"≤ {most:g}"
        case least, None:
            return f"≥ {least:g}"
        case least, most:
            return f"{least:g} to {most:g}"


def refused(act: Callable[[], object], kind: type[CellError] = CellError) -> bool:
    """Whether what `act` commands is refused by an error of this kind."""
    try:
        act()
    except kind:
        return True
    return False


FILE, PROTOCOL = "progress.json", "protocol.html"
VERSION = 1


class Progress:
    """The results so far, in `folder`; `cell` says which cell they are of (name, simulated or not, which world)."""

    def __init__(self, folder: Path, cell: dict[str, object], job: Job) -> None:
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
                for stored in self._data["results"].values():
                    stored["rests_on"], stored["verdict"]
                self._data["mended"][:]
            except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
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
        return str(stored["verdict"]) if stored["rests_on"] == self._rests_on(check, config) else "stale"

    def keep(self, check: CommissionCheck, config: CellConfig, result: Result, seconds: float, run: str) -> None:
        """Store a result, and write the file."""
        stored = {
            **result.as_dict(), "when": time.strftime("%Y-%m-%d %H:%M:%S"), "seconds": round(seconds, 1), "run": run,
            "rests_on": self._rests_on(check, config),
        }  # fmt: skip
        self._data["results"][check.name] = stored
        self._write()

    def keep_mended(self, check: CommissionCheck, finding: dict[str, object], backup: str) -> None:
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


def _at(tables: dict[str, object], key: str) -> Any:
    value: Any = tables
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value


# --- the protocol ---


class ProtocolRow(NamedTuple):
    """A check and how it stands, with its stored `result` (None: not done); `readings` beside what is allowed."""

    check: CommissionCheck
    standing: str
    result: Mapping[str, Any] | None
    readings: Sequence[tuple[Reading, str]]
    pictures: Sequence[Path]


def write_protocol(progress: Progress, checks: Sequence[CommissionCheck], config: CellConfig) -> Path:
    """Write the page beside the record of the progress; returns its path."""
    cell = progress.cell
    world = (f"{name} {value}" for name, value in cell.items() if name != "simulated" and value is not None)
    text = render(
        __package__, "protocol.html.jinja", cell=config.cell.name, simulated=bool(cell.get("simulated")),
        world=", ".join(world), written=time.strftime("%Y-%m-%d %H:%M:%S"), release=release(),
        rows=[_row(progress, check, progress.standing(check, config)) for check in checks], mended=progress.mended,
    )  # fmt: skip
    path = progress.folder / PROTOCOL
    path.write_text(text, encoding="utf-8")
    return path


def _row(progress: Progress, check: CommissionCheck, standing: str) -> ProtocolRow:
    result = progress.result(check.name)
    kept = {"readings": [], "pictures": [], **(result or {})}
    readings = [Reading(row["what"], row["value"], row["unit"], row["least"], row["most"]) for row in kept["readings"]]
    pictures = [path for name in kept["pictures"] if (path := progress.folder / name).is_file()]
    return ProtocolRow(check, standing, result, [(reading, bounds(reading)) for reading in readings], pictures)

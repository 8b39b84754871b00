"""Which run can be resumed, and with what: its job as it was, and its sweep if that may still hold."""

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Self

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig
from cell.config.job import Job, item_names, job_and_item, job_path, load_job
from cell.procedures.arm.moves import PartState
from cell.procedures.sought_part import sought
from cell.procedures.steps import laser_sweep, verify
from cell.procedures.steps.pick import HeldPart
from cell.procedures.sweep.stored_sweep import FILE, StoredSweep
from cell.run.folder import list_runs
from drivers.errors import ConfigError, RefusedError
from statemachine.journal import JournalError, JournalRecord, read


@dataclass(frozen=True)
class UnfinishedRun:
    """A run that did not come to its end: its folder, its job, and what its journal says of it.

    `swept` tells whether its last sweep was finished, and not decided to be done again; `held` how the claw holds a
    part that the run had taken from its nest.
    """

    folder: Path
    job: str
    info: dict[str, Any]
    swept: bool
    held: HeldPart | None = None

    @classmethod
    def find(cls, folder: Path, *, scripted: bool = False) -> Self:
        """The run in `folder`; `ConfigError` when it came to an end of its own, or its job is another one by now. A run
        that a script looked at is only found for one that is `scripted` as well."""
        try:
            record = read(folder, whole=True)
        except JournalError as error:
            raise ConfigError(
                f"{folder} cannot be resumed: {error}. What became of its part is not known: look at it, fold the arm "
                "with `cell home`, then run the job anew"
            ) from error
        run = record.run
        if run.outcome in ("placed", "done", "refused", "misplaced"):
            raise ConfigError(
                f"run {folder.name} has ended {run.outcome} ({run.reason}); only a run that was aborted, faulted or "
                "cut short can be resumed. Run its job again"
            )
        held = _held(record)
        _require_held(folder, record, held)
        for later, told in _later(folder):
            if told.run.info.get("resumed_from") == folder.name:
                raise ConfigError(
                    f"run {folder.name} was resumed already, by run {later.name}, which has ended "
                    f"{told.run.outcome or 'without an outcome'}: resume that one, or run the job again"
                )
        if run.info.get("scripted") and not scripted:
            raise ConfigError(
                f"run {folder.name} was looked at by a script between its steps: without it, it is not resumed. Call "
                "Cell.resume with that script, or run the job again"
            )
        for name in ("job_file", "job_hash", "simulated"):
            if name not in run.info:
                raise ConfigError(f"run {folder.name} does not tell its {name}; run the job again")
        for name, kinds in FACTS.items():
            if name in run.info and type(run.info[name]) not in kinds:
                raise ConfigError(
                    f"the journal of run {folder.name} tells its {name} as {run.info[name]!r}; run the job again"
                )
        job, told = run.info["job_file"], run.info["job_hash"]
        try:
            changed = job_hash(job) != told
        except (OSError, ValueError) as error:
            raise ConfigError(f"the job of run {folder.name} cannot be read: {error}; run a job anew") from error
        if changed:
            raise ConfigError(f"{job} or a mesh of it was changed since run {folder.name}; run the job again")
        return cls(folder, job, run.info, _swept(record), held)

    def sweep(self, job: Job, config: CellConfig, calibration: CellCalibration) -> tuple[StoredSweep | None, str]:
        """The run's sweep, or None, and why it is or is not used; whether the station moved is seen later."""
        if not self.swept or not (self.folder / FILE).exists():
            return None, f"run {self.folder.name} had not finished its sweep"
        if self.info["simulated"]:
            return None, "the simulated world of that run has ended"
        for later, told in _later(self.folder):
            if told.run.info.get("job_file") == self.job and _part(told) != PartState.HELD.value:
                return None, f"a part was put down since, by run {later.name}"
        now = {"configuration_hash": config.calibration_hash(), "calibration_hash": calibration.hash()}
        for name, value in now.items():
            if self.info.get(name) != value:
                return None, f"the {name.removesuffix('_hash')} was changed since run {self.folder.name}"
        try:
            stored = StoredSweep.load(self.folder, calibration.scan, job.scan, config.laser.exit_point)
        except RefusedError as error:
            return None, str(error)
        return stored, f"the sweep of run {self.folder.name} is used if the board has not moved"


FACTS: dict[str, tuple[type, ...]] = {
    "job_file": (str,), "job_hash": (str,), "configuration_hash": (str,), "calibration_hash": (str,),
    "simulated": (bool, str, list), "seed": (int, NoneType), "level": (str, NoneType), "clock": (str,),
    "speed": (int, float, NoneType), "pace": (int, float), "until": (str,), "scripted": (bool,),
}  # fmt: skip
"""What a journal tells of a run that a resumed one goes by, where it is there."""


def _later(folder: Path) -> Iterator[tuple[Path, JournalRecord]]:
    """The runs beside this one that began after it, as far as their journals can be read."""
    for other in list_runs(folder.parent):
        if other.name > folder.name:
            with suppress(JournalError, ValueError, TypeError):
                yield other, read(other)


def _part(record: JournalRecord) -> object:
    return next((e.data["part"] for e in reversed(record.events) if "part" in e.data), PartState.HELD.value)


def _held(record: JournalRecord) -> HeldPart | None:
    """How the claw holds a part that lay in its nest, by the run's own pick or that of the run which it resumed."""
    told = record.run.info.get("held", {})
    for event in record.events:
        told = event.data.get("held", {}) if "part" in event.data else told
    with suppress(ValueError, TypeError, KeyError):
        return HeldPart.of(told)
    return None


def _require_held(folder: Path, record: JournalRecord, held: HeldPart | None) -> None:
    """`ConfigError` when the part is not in the claw any more, or may not be."""
    gripped = "held" in record.run.info or any("part" in event.data for event in record.events)
    match _part(record):
        case PartState.HELD.value if held is not None or not gripped:
            return
        case PartState.LIES.value | PartState.NESTED.value:
            return
        case PartState.HELD.value:
            raise ConfigError(
                f"run {folder.name} had gripped a part that lay: how the claw holds it is not known, and the run is "
                "not resumed. Take the part out by hand, fold the arm with `cell home`, then run the job anew"
            )
        case PartState.RELEASED.value:
            step = next(event.step for event in reversed(record.events) if "part" in event.data)
            after = step in record.done or step == verify.STEP.name
            following = record.run.info.get("next_item", "the job with the next part")
            failed = "what came after that" if after else "only the retreat"
            raise ConfigError(
                f"run {folder.name} had put its part down already, {failed} failed: there is nothing to resume. Look "
                f"at the part, fold the arm with `cell home`, then run {following}"
            )
        case state:
            how = f"tells of its part {str(state)[:40]!r}, which is neither held nor released"
            if state == PartState.UNKNOWN.value:
                how = "ended while the claw was releasing or gripping its part"
            raise ConfigError(
                f"run {folder.name} {how}: whether the claw still has it is not known, and the run is not resumed. "
                "Look what has become of the part, fold the arm with `cell home`, then run the job anew"
            )


def _swept(record: JournalRecord) -> bool:
    sweeps = [step for step in record.steps if step.name == laser_sweep.STEP.name]
    if not sweeps or sweeps[-1].state != "done" or sweeps[-1].ended is None:
        return False
    # Whatever a script had done again after it, it was not content with what came of the sweep.
    return not any(event.kind == "decided" and event.at >= sweeps[-1].ended for event in record.events)


def job_source(name: str | Path) -> dict[str, object]:
    """For journal and report: the job's file and its hash, and the file and the hash of each of its meshes alone."""
    whole, number = job_and_item(name)
    path = str(job_path(name).resolve()) + ("" if number is None else f"#{number}")
    job, mesh = load_job(path)
    part: dict[str, object] = {} if job.part is None else {"part_mesh": mesh_source(Path(job.part.mesh))}
    if number is not None and f"{whole}#{number + 1}" in item_names(whole):
        part["next_item"] = f"{job_path(name).resolve()}#{number + 1}"
    return {"job_file": path, "job_hash": job_hash(path), "mesh": mesh_source(sought(job, mesh)[1]), **part}


def mesh_source(mesh: Path) -> dict[str, str]:
    """A mesh's file, and its hash alone."""
    return {"file": str(mesh.resolve()), "sha256": hashlib.sha256(mesh.read_bytes()).hexdigest()}


def job_hash(name: str | Path) -> str:
    """Hash of a job's file and of its meshes; `ConfigError` when there is no such job any more."""
    job, mesh = load_job(name)
    files = [job_path(name), mesh, *([] if job.part is None else [Path(job.part.mesh)])]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]

"""One simulated cell from its calibration to the placed part, on the virtual clock, by the product's own runner."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cell.config.calibrations.store import CellCalibration, solve_observations
from cell.config.cell_config import NO_FILES, CellConfig
from cell.config.job import Job, load_job
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration import ScanObservation, TargetObservation
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.reference_plate import with_edge
from cell.procedures.calibrate.timing import look_at_shutter
from cell.procedures.drive.way import Whereabouts
from cell.procedures.frame_store import Cut, FrameStore
from cell.procedures.sought_part import nominal_of, sought
from cell.procedures.steps.kinds import kind_of
from cell.procedures.steps.workplace import Workplace
from cell.run.calibration import observe_boards
from cell.run.job_run import JobRun, ReadyJob
from cell.run.recorded_work import RecordedWork, WorkContext, classify
from cell.run.resumption import mesh_source
from cell.run.runs import Run
from drivers.errors import CellError
from drivers.interfaces import Frame, Vector
from sim_backends.direct.camera import Shot
from statemachine.runner import NO_SCRIPT
from statemachine.step import Event

Result = TypeVar("Result")


def job_and_surface(name: str | Path) -> tuple[Job, NominalSurface]:
    """A job that ships, or of a file, and its surface."""
    job, mesh = load_job(name)
    return job, NominalSurface.load(mesh, unit=job.surface.mesh_unit)


class NoFrames(FrameStore):
    """Keeps no frame: a campaign has no use for them."""

    def __init__(self) -> None:
        """Nothing to write to."""

    def keep(self, what: str, frame: Frame, cut: Cut | None = None) -> None:
        """Let it go."""

    def settle(self) -> dict[str, str]:
        """There is none."""
        return {}


@dataclass(eq=False)
class JobRecord:
    """How one simulated cell did: `outcome` is placed, refused, faulted or aborted, `stage` what it came to.

    `results` are the steps' results by name; `at_sweep` and `at_end` are the world's truth then. `kinematic` is the
    configured (6, 6) covariance of a place that the arm goes to, `placing` that of the flange each time it comes to
    rest; `rests` (n, 6) the joint angles at the end of each motion, rad; `shots` the truth at each line of the cloud,
    sweep after sweep. `folder` is the run's, where it was kept.
    """

    seed: int
    level: str
    outcome: str = "placed"
    reason: str = ""
    stage: str = "calibrate"
    calibration: CellCalibration | None = None
    observations: tuple[list[ScanObservation], list[TargetObservation]] = ([], [])
    results: dict[str, Any] = field(default_factory=dict)
    at_sweep: dict[str, Any] | None = None
    at_end: dict[str, Any] | None = None
    kinematic: Vector | None = None
    placing: Vector | None = None
    rests: Vector | None = None
    shots: list[Shot] = field(default_factory=list)
    folder: Path | None = None


def run_whole_job(
    config: CellConfig, job: Job, nominal: NominalSurface, seed: int, level: str,
    calibrated: JobRecord | None = None, stood: float = 0.0, runs: Path | None = None,
    changed: Callable[[VirtualCell], None] = lambda cell: None,
) -> JobRecord:  # fmt: skip
    """Calibrate the cell of `seed` and `level`, then do the job; raises nothing that the product names.

    `calibrated` is a record of the same cell, whose calibration is used again. The cell stands idle for `stood` s
    before the job. With `runs` its run's folder is kept there. `changed` changes the cell before anything is done.
    """
    assert nominal.source is not None
    if runs is None:
        config = config.model_copy(update={"cell": config.cell.model_copy(update=NO_FILES)})
    cell = VirtualCell(config, seed, level, Described(job, nominal.source))
    changed(cell)
    job, mesh = sought(job, nominal.source)
    nominal = nominal if mesh == nominal.source else nominal_of(job, mesh)
    record = JobRecord(seed, level)
    whole = _WholeJob(cell, config, job, nominal, record)
    try:
        with nullcontext(runs) if runs else tempfile.TemporaryDirectory(prefix="cell-bench-") as folder:
            Run("job", lambda run: whole.perform(run, Path(folder), calibrated, stood)).result()
    except CellError as error:
        failure = classify(error)
        record.outcome, record.reason = failure.outcome.value, failure.reason
    record.at_end = cell.truth()
    before = [] if calibrated is None or calibrated.rests is None else list(calibrated.rests)
    record.rests = np.array([*before, *cell.arm.rests])
    return record


def on_calibrated(
    config: CellConfig, job: Job, nominal: NominalSurface, seed: int, level: str,
    work: Callable[[VirtualCell, CellCalibration, WorkContext], Result],
) -> Result:  # fmt: skip
    """Calibrate the cell of `seed` and `level`, and do `work` on it as recorded work; raises what that raises."""
    assert nominal.source is not None
    cell = VirtualCell(config, seed, level, Described(job, nominal.source))
    whole = _WholeJob(cell, config, job, nominal, JobRecord(seed, level))

    def done(context: WorkContext) -> Result:
        calibration = whole._calibrate(context)
        cell.devices.interlocks.work_with(calibration.configuration)
        return work(cell, calibration, context)

    with tempfile.TemporaryDirectory(prefix="cell-bench-") as folder:

        def perform(run: Run[Result]) -> Result:
            return RecordedWork(run, "calibration", cell.devices, Path(folder), cell.facts).perform(done)

        return Run("calibration", perform).result()


@dataclass(frozen=True, eq=False)
class _WholeJob:
    cell: VirtualCell
    config: CellConfig
    job: Job
    nominal: NominalSurface
    record: JobRecord

    def perform(self, run: Run[None], folder: Path, calibrated: JobRecord | None, stood: float) -> None:
        """Fill the record; runs go to `folder`."""
        record, devices = self.record, self.cell.devices
        if calibrated is not None:
            record.calibration, record.observations = calibrated.calibration, calibrated.observations
        else:
            work = RecordedWork(run, "calibration", devices, folder, self.cell.facts)
            record.calibration = work.perform(self._calibrate)
        assert record.calibration is not None and self.nominal.source is not None
        whereabouts = Whereabouts(devices.vehicle)
        whereabouts.say_at_start()
        workplace = Workplace(
            self.config, self.job, self.nominal, record.calibration, devices, NoFrames(), folder, whereabouts
        )
        record.kinematic, record.placing = workplace.kinematic, workplace.repeatability
        self.cell.world.stand(stood)
        job_run = JobRun(
            run, self.config, devices, ReadyJob(self.job, kind_of(self.job), self.nominal, NO_SCRIPT, {}),
            calibration=record.calibration, info={**self.cell.facts, "mesh": mesh_source(self.nominal.source)},
            inline=(self._follow,), truth=self.cell.truth,
        )  # fmt: skip
        ended = job_run.perform(folder, whereabouts)
        record.results, record.folder = dict(ended.results), ended.folder
        if ended.outcome != "placed":
            record.outcome, record.reason = ended.outcome, ended.reason
        if "laser_sweep" in record.results:
            frames = [number for swath in record.results["laser_sweep"].swaths for number in swath.frame_ids]
            record.shots = [self.cell.scan_camera.shots[int(number)] for number in frames]

    def _calibrate(self, context: WorkContext) -> CellCalibration:
        mover = Mover(self.cell.devices.arm, self.cell.clock, self.config, self.job, context.safe_point)
        self.cell.devices.vehicle.brake()
        devices, keep = self.cell.devices, NoFrames().keep
        seen = observe_boards(self.config, devices, mover, replace(context, keep=keep), lambda fraction, text: None)
        self.record.observations = seen.scan, seen.target
        made = solve_observations(seen).calibration
        made = look_at_shutter(self.config, devices, mover, made, context.check, keep)
        return with_edge(self.config, devices, keep, made)

    def _follow(self, event: Event) -> None:
        """What the run comes to."""
        if event.kind == "step_started" and event.step in kind_of(self.job).names:
            self.record.stage = str(event.step)
        if event.kind == "step_done" and event.step == "laser_sweep":
            self.record.at_sweep = self.cell.truth()

"""One simulated cell from its calibration to the placed part, on the virtual clock, by the product's own runner."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cell.config.calibrations.store import CellCalibration, gathered, solve_observations
from cell.config.cell_config import NO_FILES, CellConfig
from cell.config.job import Job, load_job
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration import ScanObservation, TargetObservation
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.boards import collect_scan, collect_target
from cell.procedures.calibrate.reference_plate import see_reference_plate, with_edge
from cell.procedures.calibrate.timing import look_at_shutter
from cell.procedures.drive.way import Whereabouts
from cell.procedures.frame_store import Cut, FrameStore
from cell.procedures.sought_part import nominal_of, sought
from cell.procedures.steps.kinds import kind_of
from cell.procedures.steps.workplace import Workplace
from cell.procedures.sweep.stored_sweep import SweepRecord
from cell.run.calibration import arm_table
from cell.run.job_run import JobRun, ReadyJob
from cell.run.recorded_work import RecordedWork, WorkContext, classify
from cell.run.resumption import mesh_source
from cell.run.runs import Run
from drivers.errors import CellError
from drivers.interfaces import Frame, Vector
from sim_backends.direct.camera import Shot
from statemachine.runner import NO_SCRIPT
from statemachine.step import Event

Progress = Callable[[float, str], None]
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
    sweep after sweep. `wall_s` are seconds on the wall by stage; `folder` is the run's, where it was kept.
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
    wall_s: dict[str, float] = field(default_factory=dict)
    folder: Path | None = None


def run_whole_job(
    config: CellConfig, job: Job, nominal: NominalSurface, seed: int, level: str, progress: Progress | None = None,
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
    whole = _WholeJob(cell, config, job, nominal, record, progress or (lambda fraction, text: None))
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
    whole = _WholeJob(cell, config, job, nominal, JobRecord(seed, level), lambda fraction, text: None)

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
    notify: Progress

    def perform(self, run: Run[None], folder: Path, calibrated: JobRecord | None, stood: float) -> None:
        """Fill the record; runs go to `folder`."""
        record, devices = self.record, self.cell.devices
        if calibrated is not None:
            record.calibration, record.observations = calibrated.calibration, calibrated.observations
        else:
            with _Timed(record, "calibrate"):
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
        with _Timed(record, "job"):
            ended = job_run.perform(folder, whereabouts)
        record.results, record.folder = dict(ended.results), ended.folder
        if ended.outcome != "placed":
            record.outcome, record.reason = ended.outcome, ended.reason
        if "laser_sweep" in record.results:
            record.shots = _shots(self.cell, record.results["laser_sweep"])

    def _calibrate(self, context: WorkContext) -> CellCalibration:
        mover = Mover(self.cell.devices.arm, self.cell.clock, self.config, self.job, context.safe_point)
        self.cell.devices.vehicle.brake()
        devices, notify = self.cell.devices, self.notify
        given, keep = (self.config, devices, mover, context.check), NoFrames().keep
        scan = collect_scan(*given, lambda f, t: notify(0.36 * f, f"calibrate: {t}"), keep)
        witness = see_reference_plate(self.config, devices, keep)
        target = collect_target(*given, lambda f, t: notify(0.36 + 0.12 * f, f"calibrate: {t}"), keep)
        self.record.observations = (scan, target)
        notify(0.48, "calibrate: solving")
        named = (devices.arm, devices.rail, devices.scan_camera, devices.target_camera)
        identities = {device.name: device.identity().serial for device in named}
        known = identities, self.config, arm_table(self.config, self.cell.devices), witness
        made = solve_observations(gathered(scan, target, *known)).calibration
        made = look_at_shutter(self.config, devices, mover, made, context.check, keep)
        return with_edge(self.config, devices, keep, made)

    def _follow(self, event: Event) -> None:
        """What the run comes to."""
        names = kind_of(self.job).names
        if event.kind == "step_started" and event.step in names:
            self.record.stage = str(event.step)
            self.notify(0.6 + 0.4 * names.index(str(event.step)) / len(names), str(event.step))
        if event.kind == "step_done" and event.step == "laser_sweep":
            self.record.at_sweep = self.cell.truth()


def _shots(cell: VirtualCell, sweep: SweepRecord) -> list[Shot]:
    return [cell.scan_camera.shots[int(number)] for swath in sweep.swaths for number in swath.frame_ids]


class _Timed:
    """Notes how long its block took on the wall."""

    def __init__(self, record: JobRecord, stage: str) -> None:
        self._record, self._stage = record, stage

    def __enter__(self) -> None:
        self._begun = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._record.wall_s[self._stage] = round(time.monotonic() - self._begun, 3)

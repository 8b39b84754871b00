"""One simulated cell from its calibration to the placed part, in lock step, by the product's own steps."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cell.calibration import ScanObservation, TargetObservation
from cell.calibration.collect.boards import collect_scan, collect_target
from cell.calibration.store import CellCalibration
from cell.config import CellConfig
from cell.inversion import NominalSurface
from cell.job import Job
from cell.lab.bench.lockstep import LockstepCell
from cell.lab.bench.lockstep_arm import LockstepArm
from cell.lab.bench.lockstep_camera import LockstepCamera, Shot
from cell.run.frames import FrameStore
from cell.run.job_run import classify
from cell.run.work import JobWork
from cell.steps.laser_sweep import SweepRecord
from cell.steps.moves import Mover
from cell.steps.whereabouts import Whereabouts
from drivers.errors import CellError
from drivers.interfaces import Frame, Vector
from sim_backends.world.truth import truth
from statemachine.policy import Policy
from statemachine.runner import StepContext
from statemachine.sequence import State

Progress = Callable[[float, str], None]


class NoFrames(FrameStore):
    """Keeps no frame: a campaign has no use for them."""

    def __init__(self) -> None:
        """Nothing to write to."""

    def keep(self, what: str, frame: Frame) -> None:
        """Let it go."""


@dataclass(eq=False)
class JobRecord:
    """How one simulated cell did: `outcome` is placed, refused, faulted or aborted, `stage` what it came to.

    `results` are the steps' results by name; `at_sweep` and `at_end` are the world's truth then. `kinematic` is the
    configured (6, 6) covariance of a place that the arm goes to; `rests` (n, 6) the joint angles at the end of each
    motion, rad; `shots` the truth at each line of the cloud, sweep after sweep. `wall_s` are seconds on the wall by
    stage.
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
    rests: Vector | None = None
    shots: list[Shot] = field(default_factory=list)
    wall_s: dict[str, float] = field(default_factory=dict)


def run_whole_job(
    config: CellConfig,
    job: Job,
    nominal: NominalSurface,
    seed: int,
    level: str,
    progress: Progress | None = None,
    calibrated: JobRecord | None = None,
) -> JobRecord:
    """Calibrate the cell of `seed` and `level`, then do the job; raises nothing that the product names.

    Refusals and faults end it as they end a run, without the runner's repetitions. `calibrated` is a record of the same
    cell, whose calibration is used again.
    """
    tell = progress or (lambda fraction, text: None)
    record = JobRecord(seed, level)
    cell = LockstepCell(config, seed, level, Path(job.surface.mesh).stem)
    try:
        if calibrated is not None:
            record.calibration, record.observations = calibrated.calibration, calibrated.observations
        else:
            with _Timed(record, "calibrate"):
                record.calibration = _calibrate(
                    cell, config, job, record, lambda f, t: tell(0.6 * f, f"calibrate: {t}")
                )
        with tempfile.TemporaryDirectory(prefix="cell-bench-") as folder:
            _steps(cell, config, job, nominal, record, Path(folder), tell)
    except CellError as error:
        failure = classify(error)
        record.outcome, record.reason = failure.outcome.value, failure.reason
    record.at_end = truth(cell.world)
    arm = cell.devices.arm
    assert isinstance(arm, LockstepArm)
    before = [] if calibrated is None or calibrated.rests is None else list(calibrated.rests)
    record.rests = np.array([*before, *arm.rests])
    return record


def _calibrate(cell: LockstepCell, config: CellConfig, job: Job, record: JobRecord, tell: Progress) -> CellCalibration:
    mover = Mover(cell.devices.arm, cell.clock, config, job)
    cell.devices.vehicle.brake()
    keep = NoFrames().keep
    scan = collect_scan(config, cell.devices, mover, _never, lambda f, t: tell(0.6 * f, t), keep)
    target = collect_target(config, cell.devices, mover, _never, lambda f, t: tell(0.6 + 0.2 * f, t), keep)
    record.observations = (scan, target)
    tell(0.8, "solving")
    return CellCalibration.solve(scan, target, cell.identities(), config)


def _steps(
    cell: LockstepCell,
    config: CellConfig,
    job: Job,
    nominal: NominalSurface,
    record: JobRecord,
    folder: Path,
    tell: Progress,
) -> None:
    assert record.calibration is not None
    whereabouts = Whereabouts(cell.devices.vehicle)
    whereabouts.say_at_start()
    work = JobWork(config, job, nominal, record.calibration, cell.devices, NoFrames(), folder, whereabouts)
    record.kinematic = work.kinematic
    policy = Policy()
    for k, (name, step) in enumerate(work.steps().items()):
        record.stage = name
        tell(0.6 + 0.4 * k / 6, name)
        context = StepContext(policy.of(State(name)), 1, math.inf, dict(record.results), cell.clock, _ignore)
        with _Timed(record, name):
            record.results[name] = step(context)
        if name == "laser_sweep":
            record.at_sweep = truth(cell.world)
            record.shots = _shots(cell, record.results[name])


def _shots(cell: LockstepCell, sweep: SweepRecord) -> list[Shot]:
    camera = cell.devices.scan_camera
    assert isinstance(camera, LockstepCamera)
    return [camera.shots[int(number)] for swath in sweep.swaths for number in swath.frame_ids]


class _Timed:
    """Notes how long its block took on the wall."""

    def __init__(self, record: JobRecord, stage: str) -> None:
        self._record, self._stage = record, stage

    def __enter__(self) -> None:
        self._begun = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._record.wall_s[self._stage] = round(time.monotonic() - self._begun, 3)


def _never() -> None:
    """Nobody asks a campaign's cell to stop."""


def _ignore(event: object) -> None:
    """Nobody watches the steps."""

"""One world: the cell of a level and seed is calibrated, then runs the job, both by the product's ordinary runner.

The course is that of `cell dry-run -c FOLDER/cell.toml --clock virtual` in the world's own folder: its calibration lies
there. Nothing else of a run is kept.
"""

import gc
import logging
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.apps.qualify.identity import QualifiedCode
from cell.apps.qualify.rows import Row, error_row, row_of
from cell.base.compiled import load
from cell.base.storage import replacing
from cell.config.calibrations.store import archive_of
from cell.config.cell_config import DEVICES, NO_FILES, CellConfig, load_config
from cell.config.job import Job, item_names, load_job
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface
from cell.procedures.part_error import part_points
from cell.procedures.sought_part import nominal_of, sought
from cell.run.folder import Report
from cell.run.job_run import RunOutcome
from cell.run.recorded_work import classify
from cell.run.report.report import pose_of
from cell.run.session.session import OpenCell
from cell.run.session.supervisor import Cell
from drivers.errors import Aborted, CalibrationStale, CellError, ConfigError

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables: the sums are then the same on every machine, and the cores are full."""
CALIBRATING = "calibrate"
"""The step in which a world ended whose calibration was not good enough."""


@dataclass(frozen=True)
class WorldTask:
    """What a worker needs: the file of the job, the text of the configuration, the campaign's `folder`, and which
    world. Workers on other machines find the same files at the same paths."""

    of: QualifiedCode
    job: str
    configuration: str
    folder: Path
    level: str
    seed: int

    @property
    def key(self) -> str:
        """The key of its row."""
        return self.of.key(self.level, self.seed)

    @property
    def config_file(self) -> Path:
        """The configuration in the world's own folder, beside its calibrations."""
        return self.folder / "worlds" / self.of.short / f"{self.level}-{self.seed}" / "cell.toml"


def run_world(task: WorldTask) -> Row | None:
    """Calibrate the cell of this world, unless that was done before, and run the job: its row.

    None where a signal ended it. What the run raises becomes a row. Raises `ConfigError` where this worker has another
    code, job or configuration than the campaign: its row would be of something else.
    """
    _be_a_worker()
    begun = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="cell-qualify-") as scratch:
            config = _config(task, Path(scratch))
            _require_same(task, config)
            row = _row(task, config, Path(scratch))
    except Aborted:
        return None
    finally:
        # A world is large, and full of circles: not every one would be gone before the next.
        gc.collect()
    return None if row is None else row | {"wall_s": round(time.monotonic() - begun, 3), "ended_s": time.time()}


def _row(task: WorldTask, config: CellConfig, scratch: Path) -> Row | None:
    calibrated = False
    try:
        _calibrate(task, config)
        calibrated = True
        runs, covered = _run(task, config)
    except Aborted:
        raise
    except Exception as error:
        outcome, step, code, reason = "error", "", type(error).__name__, f"{type(error).__name__}: {error}"
        if isinstance(error, CellError) and not calibrated:
            failure = classify(error)
            outcome, step, code, reason = failure.outcome.value, CALIBRATING, failure.code, failure.reason
        reason = _plain(reason, scratch, task)
        return error_row(task.of, task.level, task.seed, outcome=outcome, step=step, code=code, reason=reason)
    if any(run.interrupted for run in runs):
        return None
    row = row_of(task.of, task.level, task.seed, reports=[run.report for run in runs], covered=covered)
    return row | {"reason": _plain(str(row["reason"]), scratch, task)}


def _plain(text: str, scratch: Path, task: WorldTask) -> str:
    """Without folders that are others each time."""
    return text.replace(str(scratch), "RUNS").replace(str(task.config_file.parent), "WORLD")


def _config(task: WorldTask, scratch: Path) -> CellConfig:
    """The configuration from the world's folder, as a dry run has it; its runs leave only reports, in `scratch`."""
    file = task.config_file
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as out:
            out.write(task.configuration.encode())
    config = load_config(file)
    changed = {**NO_FILES, "runs": str(scratch), "sim": tuple(DEVICES), "confirm": "simulated"}
    return config.model_copy(update={"cell": config.cell.model_copy(update=changed)})


def _opened(task: WorldTask, config: CellConfig) -> Cell:
    load()
    virtual = VirtualCell(config, task.seed, task.level, Described.of(task.job))
    return Cell(OpenCell(config, task.config_file.parent, nullcontext(), virtual.devices, virtual))


def _calibrate(task: WorldTask, config: CellConfig) -> None:
    """Calibrate in a world of its own, so that the job's course is the same whether that was done before or not."""
    with _opened(task, config) as cell:
        try:
            cell.calibration()
        except CalibrationStale:
            made = cell.calibrate(job=task.job)
            archive_of(cell.calibrations_folder, made).unlink(missing_ok=True)


def _run(task: WorldTask, config: CellConfig) -> tuple[Sequence[RunOutcome], float | None]:
    """The run of the job, or one of each of its items; and the share of a single part's points within the bound."""
    with _opened(task, config) as cell:
        if len(item_names(task.job)) > 1:
            return cell.run_batch(task.job).runs, None
        run = cell.run(task.job)
        job, mesh = sought(*load_job(task.job))
        assert cell.simulated is not None
        return (run,), points_covered(run.report, job, nominal_of(job, mesh), cell.simulated.truth())


def points_covered(report: Report, job: Job, nominal: NominalSurface, truth: dict[str, object]) -> float | None:
    """The share of the part's 45 points that ended within the stated 95 % bound; None where there is no bound or no
    true place. `truth` is the world's after the run."""
    bound = report.get("place_bound_95")
    if report.get("truth") is None or bound is None:
        return None
    points = part_points(nominal)
    ended = transform(pose_of(truth, "surface_from_part"), points)
    off = 1e3 * np.linalg.norm(ended - transform(job.place.surface_from_part.se3(), points), axis=1)
    return float(np.mean(off <= float(bound["d"])))


def _require_same(task: WorldTask, config: CellConfig) -> None:
    """Raise `ConfigError` unless this worker has what the campaign is of."""
    try:
        here = QualifiedCode.of(task.job, config)
    except ConfigError as error:
        raise ConfigError(f"a worker cannot read what this campaign is of: {error}") from error
    if here != task.of:
        raise ConfigError(
            f"a worker has another code, job or configuration ({here}) than this campaign ({task.of}); install the "
            "same release there and give all machines the same files, then run the same command again"
        )


def limit_threads() -> None:
    """One thread for linear algebra, in this process and those that inherit its environment."""
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")


def _be_a_worker() -> None:
    import cv2

    limit_threads()
    cv2.setNumThreads(1)
    # What a run warns of is in its row; a worker has nobody who reads it.
    if not (root := logging.getLogger()).handlers:
        root.addHandler(logging.NullHandler())
        # Modules stay: the collection after each world has not to look at them.
        gc.collect()
        gc.freeze()

"""Runs for the tests of what is said at the end: the product's own steps on the cell without wires, ended in many ways.

What a step returns or raises is the product's; only the runner's record of it is put together here.
"""

import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from cell.config.cell_config import load_config
from cell.config.job import AreaSection, Job, load_job
from cell.devices.simulated.direct import VirtualCell
from cell.devices.simulated.process import ask_truth
from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface
from cell.procedures.drive.way import Whereabouts
from cell.procedures.frame_store import FrameStore
from cell.procedures.steps.kinds import PLACE
from cell.procedures.steps.workplace import Workplace
from cell.run.folder import new_run
from cell.run.recorded_work import classify
from cell.run.report.report import FinishedJob, TruthRecorder, pose_of
from cell.run.resumption import job_source
from drivers.errors import CellError
from lab.bench.job.whole_job import JobRecord
from statemachine.runner import FaultRecord, RunResult, StepContext, StepRecord
from statemachine.step import Failure, Outcome

CONFIG = load_config(None)
NAMES = list(PLACE.names)
LOST = FaultRecord(
    1_790_000_000.0, "laser_sweep", 1, "camera.frames_lost", "scan_camera: 61 frames were lost", "tried again"
)


LEFT = AreaSection.model_validate({"name": "left", "centre": ["-16 mm", "0 mm"], "size": ["30 mm", "30 mm"]})
"""An area of the surface of `pot` whose waviness is told by itself."""


def pot(**scan: object) -> tuple[Job, NominalSurface]:
    """The job `pot`, swept twice as fast as shipped, and its surface."""
    job, mesh = load_job("pot")
    job = job.model_copy(update={"scan": job.scan.model_copy(update={"speed": 0.030, **scan})})
    return job, NominalSurface.load(mesh)


def changed(job: Job, section: str, **values: object) -> Job:
    """A job with other values in one section."""
    return job.model_copy(update={section: getattr(job, section).model_copy(update=values)})


@dataclass(frozen=True, eq=False)
class Ended:
    """A run's report and its folder."""

    report: dict[str, Any]
    folder: Path


def work_of(
    cell: VirtualCell, job: Job, nominal: NominalSurface, record: JobRecord, frames: FrameStore, folder: Path
) -> Workplace:
    """The workplace of a job on a cell whose vehicle stands at its start."""
    assert record.calibration is not None
    whereabouts = Whereabouts(cell.devices.vehicle)
    whereabouts.say_at_start()
    return Workplace(CONFIG, job, nominal, record.calibration, cell.devices, frames, folder, whereabouts)


def at_station(cell: VirtualCell, record: JobRecord, further: float = 0.0) -> None:
    """Put the vehicle where it stood at the end of `record`, and so many metres further."""
    assert record.at_end is not None
    stood, vehicle = pose_of(record.at_end, "world_from_vehicle"), cell.world.vehicle
    way = stood.rotation[:, 0]
    vehicle._x, vehicle._y = (float(v) for v in (stood.translation + further * way)[:2])
    vehicle._yaw = math.atan2(way[1], way[0])


def tried(record: JobRecord, job: Job, nominal: NominalSurface, step: str, root: Path) -> Ended:
    """A run on a cell just started that did the steps before `step` as in `record` and then this one, by itself."""
    assert record.calibration is not None
    folder = new_run(root)
    cell = VirtualCell(CONFIG, record.seed, record.level)
    if step == "place":
        at_station(cell, record)
    cell.devices.vehicle.brake()
    before = {name: record.results[name] for name in NAMES[: NAMES.index(step)]}
    with FrameStore(folder / "frames") as frames:
        work = work_of(cell, job, nominal, record, frames, folder)
        context = StepContext(PLACE.policy().of(step), 1, math.inf, before, cell.clock, lambda event: None)
        try:
            made = PLACE.work(work)[step](context)
        except CellError as error:
            failed, failure = error, classify(error)
        else:
            raise AssertionError(f"{step} was to fail, it made {made}")
    result = RunResult(failure.outcome, failure.reason, failure.code, records(step), before, failed)
    return reported(work, result)


def records(failed: str | None, faults: tuple[FaultRecord, ...] = ()) -> tuple[StepRecord, ...]:
    """The runner's records of a run that failed in the step of this name, or in none."""
    last = len(NAMES) if failed is None else NAMES.index(failed)
    states = ["done"] * last + ["failed"] * (failed is not None)
    again = Counter(fault.step for fault in faults if fault.remedy == "tried again")
    done = [StepRecord(name, state, 12.34, again[name], 12.51) for name, state in zip(NAMES, states, strict=False)]
    return (*done, *(StepRecord(name) for name in NAMES[len(done) :]))


def placed(record: JobRecord, root: Path) -> Ended:
    """The run of `record`, in which frames were lost once."""
    return of_placed(record, root, (LOST,))


def real(record: JobRecord, root: Path) -> Ended:
    """The same as a real cell reports it, without a truth."""
    return of_placed(record, root, simulated=False)


@contextmanager
def begun(record: JobRecord, root: Path) -> Iterator[Workplace]:
    """Where a run of `record` in a new folder works; its frames are kept until the end."""
    folder = new_run(root)
    cell = VirtualCell(CONFIG, record.seed, record.level)
    job, nominal = pot()
    with FrameStore(folder / "frames") as frames:
        yield work_of(cell, changed(job, "surface", area=(LEFT,)), nominal, record, frames, folder)


def of_placed(record: JobRecord, root: Path, faults: tuple[FaultRecord, ...] = (), *, simulated: bool = True) -> Ended:
    """The report of a run that placed."""
    result = RunResult(Outcome.PLACED, "all steps done", "", records(None, faults), record.results, faults=faults)
    with begun(record, root) as work:
        pass
    if not simulated:
        return reported(work, result, simulated=False)
    at_end = record.at_end
    assert at_end is not None
    witness = TruthRecorder(lambda: at_end)
    witness.at_sweep = record.at_sweep
    return reported(work, result, witness)


def ended(record: JobRecord, root: Path, failure: Failure, step: str, faults: tuple[FaultRecord, ...] = ()) -> Ended:
    """A run of `record` that broke off in `step`, with nothing to show for it."""
    with begun(record, root) as work:
        work.frames.keep("stripe", record.results["laser_sweep"].middle)
    before = {name: record.results[name] for name in NAMES[: NAMES.index(step)]}
    result = RunResult(
        failure.outcome, failure.reason, failure.code, records(step, faults), before, CellError(failure.reason),
        faults=faults,
    )  # fmt: skip
    return reported(work, result)


def reported(
    work: Workplace, result: RunResult, witness: TruthRecorder | None = None, *, simulated: bool = True
) -> Ended:  # fmt: skip
    """The report of a result, with the facts that `cell.run.job_run.JobRun` adds."""
    config, job = work.config, work.job
    info: dict[str, Any] = {
        "kind": "job", "pid": os.getpid(), "part": work.part.state.value, "cell": config.cell.name, "job": job.job.name,
        "job_kind": job.job.kind, "simulated": simulated, "seed": 2 if simulated else None,
        "level": "nominal" if simulated else None, "clock": "wall", "cell_s": 12.34, **job_source("pot"),
        "speed": config.cell.time_scale, "configuration_hash": config.calibration_hash(),
        "calibration_hash": work.calibration.hash(), "calibration_date": work.calibration.date,
    }  # fmt: skip
    started = time.time() - 31.0
    finished = FinishedJob(
        work.folder, config, job, work.nominal, work.repeatability,
        result=result, info=info, started=started, witness=witness, frames=work.frames,
    )  # fmt: skip
    return Ended(finished.report(), work.folder)


def with_few_lines(record: JobRecord, lines: int) -> JobRecord:
    """The record with a sweep of which only so many lines are left."""
    sweep = record.results["laser_sweep"]
    short = tuple(
        replace(
            swath, lines=swath.lines[:lines], frame_ids=swath.frame_ids[:lines], times=swath.times[:lines],
            flanges=swath.flanges[:lines], rail=swath.rail[:lines],
            line_spread=swath.line_spread[:lines],
        )
        for swath in sweep.swaths
    )  # fmt: skip
    return replace(record, results={**record.results, "laser_sweep": replace(sweep, swaths=short)})


Make = Callable[[JobRecord, Path], Ended]
"""Makes a run that ends in one particular way."""
Ends = Callable[[Make], Ended]
"""Gives such a run, which is made once for all tests."""


def no_board(record: JobRecord, root: Path) -> Ended:
    """The vehicle is where no board like the job's is seen."""
    job, nominal = pot()
    return tried(record, changed(job, "board", spec="asymmetric_dots:4x11:20mm"), nominal, "drive_to_target", root)


def blurred_board(record: JobRecord, root: Path) -> Ended:
    """The board is found, its dots miss their places by more than the job allows."""
    job, nominal = pot()
    return tried(record, changed(job, "photo", max_residual=0.001), nominal, "drive_to_target", root)


def few_points(record: JobRecord, root: Path) -> Ended:
    """The sweep brings hardly a point."""
    job, nominal = pot()
    return tried(with_few_lines(record, 1), job, nominal, "reconstruct", root)


def other_surface(record: JobRecord, root: Path) -> Ended:
    """What was scanned is not the surface that the job names."""
    job, _ = pot()
    _, mesh = load_job("seat")
    return tried(record, job, NominalSurface.load(mesh), "invert_pose", root)


def too_strict(record: JobRecord, root: Path) -> Ended:
    """The place is not known as well as the job asks for."""
    job, nominal = pot()
    return tried(record, changed(job, "place", tolerance=0.00005), nominal, "invert_pose", root)


def no_contact(record: JobRecord, root: Path) -> Ended:
    """There is nothing under the part where the scan has the surface."""
    job, nominal = pot()
    pose = record.results["invert_pose"]
    higher = replace(pose, base_from_surface=pose.base_from_surface * from_parts((0.0, 0.0, 0.005)))
    return tried(replace(record, results={**record.results, "invert_pose": higher}), job, nominal, "place", root)


def faulted(record: JobRecord, root: Path) -> Ended:
    """A device fails in the sweep, after a fault that the run had gone on from."""
    reason = (
        "arm: the arm is in emergency stop (arm.emergency_stop). Release the button when the way is clear, and power "
        "the arm on from its pendant."
    )
    fault = FaultRecord(1_790_000_004.0, "laser_sweep", 2, "arm.emergency_stop", reason, "ended the run")
    return ended(record, root, Failure(Outcome.FAULTED, reason, "arm.emergency_stop"), "laser_sweep", (LOST, fault))


def aborted(record: JobRecord, root: Path) -> Ended:
    """Somebody asks for the end during the sweep."""
    return ended(record, root, Failure(Outcome.ABORTED, "interrupted from the keyboard", "signal"), "laser_sweep")


def crippled(record: JobRecord, root: Path) -> Ended:
    """A run that placed, whose frames, truth and picture all came to grief."""
    with begun(record, root) as work:
        (work.folder / "picture.png").symlink_to("/dev/full")
        (work.folder / "frames").write_text("no folder", encoding="utf-8")
        work.frames.keep("stripe", record.results["laser_sweep"].middle)
    result = RunResult(Outcome.PLACED, "all steps done", "", records(None), record.results)
    witness = TruthRecorder(partial(ask_truth, "127.0.0.1:1"))
    return reported(work, result, witness)


def read_strictly(path: Path) -> dict[str, Any]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    return report

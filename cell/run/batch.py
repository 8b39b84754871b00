"""A batch: one job for several parts, a run each, and what came of them as counts and distributions.

Between two runs the next part is made ready. A simulated world does that by itself; at a real cell a person is asked in
a recorded run of its own: nothing moves before the answer.
"""

import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Self

from cell.base.storage import sealed, write_json
from cell.config.job import Job, job_and_item
from cell.devices.simulated.process import is_whole
from cell.procedures.arm.moves import PartState
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.placed_part import PlacedPart
from cell.procedures.steps import board_photo, drive_to_target, laser_sweep, place, verify
from cell.procedures.steps.drive_to_target import VehicleArrival
from cell.procedures.steps.place import PlaceResult
from cell.procedures.steps.workplace import HeadLook, PartsBefore
from cell.procedures.sweep.stored_sweep import SweepRecord
from cell.run.folder import Report
from cell.run.job_run import Observer, RunOutcome, each_of
from cell.run.recorded_work import WorkContext
from cell.run.session.session import OpenCell
from drivers.errors import CellError, ConfigError, DeviceFault, Interrupted
from statemachine.step import Event
from statemachine.watch import SignalInterrupt

MOST_PARTS = 10_000
GOOD = ("placed", "done")
COUNTED = ("placed", "corrected", "refused", "misplaced", "faulted", "aborted")


@dataclass(frozen=True)
class Distribution:
    """A figure of `n` placed parts, in `unit`; `sd` has n - 1 degrees of freedom, and is None of one part."""

    name: str
    unit: str
    n: int
    mean: float
    sd: float | None
    min: float
    max: float


@dataclass(frozen=True)
class BatchOutcome:
    """What came of a batch of `count` parts: the `runs` of those that were tried, and why it ended; `file` keeps it.
    `interrupted` says that a signal has ended it."""

    job: str
    count: int
    file: Path
    reason: str = "not ended, or its process died"
    interrupted: bool = False
    runs: tuple[RunOutcome, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """How many parts ended how; one that was placed again before it was good counts as corrected, not as placed."""
        found = dict.fromkeys(COUNTED, 0)
        for run in self.runs:
            good = "corrected" if _seen(run.report).get("before_mm") else "placed"
            found[good if run.outcome in GOOD else run.outcome] += 1
        return {**found, "not tried": self.count - len(self.runs)}

    @property
    def figures(self) -> tuple[Distribution, ...]:
        """How each figure of the placed parts is distributed."""
        found: dict[tuple[str, str], list[float]] = {}
        for run in self.runs:
            for which, value in figures(run.report).items() if run.outcome in GOOD else ():
                found.setdefault(which, []).append(value)
        return tuple(
            Distribution(*which, len(of), fmean(of), stdev(of) if len(of) > 1 else None, min=min(of), max=max(of))
            for which, of in found.items()
        )

    def __str__(self) -> str:
        """The newest part and the counters, in a line."""
        last, counts = self.runs[-1], ", ".join(f"{n} {name}" for name, n in self.counts.items() if n)
        ended = f"{last}; {last.report.get('cell_s')} s, {last.folder.name}"
        return f"part {len(self.runs)} of {self.count}  {ended} · {counts}"

    @property
    def exit_code(self) -> int:
        """130 interrupted, else 0 when every part was placed, 1 otherwise."""
        return 130 if self.interrupted else int(self.counts["placed"] + self.counts["corrected"] < self.count)

    def as_dict(self) -> dict[str, object]:
        """JSON-ready; the runs by their names."""
        return {
            "job": self.job, "count": self.count, "reason": self.reason, "interrupted": self.interrupted,
            "counts": self.counts, "figures": [asdict(figure) for figure in self.figures],
            "runs": [{"run": run.folder.name, "outcome": run.outcome, "reason": run.reason} for run in self.runs],
        }  # fmt: skip

    def written(self) -> Self:
        """Itself, also in its file."""
        write_json(self.file, sealed(self.as_dict()))
        return self


def _seen(report: Report) -> Report:
    """Where the placed part was seen; empty where nobody looked."""
    return next((step["result"] or {} for step in report.get("steps") or () if step["name"] == "verify"), {})


def figures(report: Report) -> dict[tuple[str, str], float]:
    """What parts of one job are compared by, by name and unit."""
    seen = _seen(report)
    found = {("cycle time", "s"): report["cell_s"]}
    if seen:
        found |= {
            ("placed part off its place at first", "mm"): [*seen["before_mm"], seen["off_mm"]][0],
            ("placed part off its place, as seen", "mm"): seen["off_mm"],
            ("corrections", ""): len(seen["before_mm"]),
        }
    if seen.get("gap"):
        found[("gap, median", "mm")] = seen["gap"]["median_mm"]
    return found | {(row["name"], row["unit"]): row["value"] for row in report["measured"] if row["value"] is not None}


def require_count(count: int) -> None:
    """`ConfigError` for a batch of so many parts."""
    if not 1 <= count <= MOST_PARTS:
        raise ConfigError(f"a batch of {count} parts is none (allowed: 1 to {MOST_PARTS}); give another count")


def perform(
    open_cell: OpenCell, jobs: Sequence[Job], count: int, run: Callable[[int, PartsBefore], RunOutcome],
    between: Callable[[Callable[[WorkContext], None]], None], observer: Observer | None,
) -> BatchOutcome:  # fmt: skip
    """Do a batch: `run(number, parts_before)` a part; `between(work)` what a person is asked
    before the next one; both wait. The parts have these `jobs` in turn, which are `count` times begun.

    `observer` is told each part's end; one that fails is told nothing more. Raises what keeps the first part from being
    begun, or is no error of the cell.
    """
    require_count(count := count * len(jobs))
    notify = each_of(() if observer is None else (observer,))
    name = f"batch-{time.strftime('%Y%m%dT%H%M%S')}-{secrets.token_hex(2)}.json"
    whole = job_and_item(jobs[0].job.name)[0]
    batch, why, interrupted = BatchOutcome(whole, count, open_cell.runs_folder / name), "", False
    before = PartsBefore()
    try:
        while not why and len(batch.runs) < count:
            number = len(batch.runs) + 1
            job = jobs[(number - 1) % len(jobs)]
            # A person makes all items ready at once.
            refill = job is jobs[0]
            part = f"part {number} of {count}"
            work = _question(open_cell, job, part, batch.runs[-1], refill=refill) if number > 1 else None
            if work is not None:
                between(work)
            elsewhere = job.board != jobs[(number - 2) % len(jobs)].board
            before = _still_known(before, elsewhere=elsewhere, asked=work is not None, refill=refill)
            # A person makes the first item of each round ready, but in a cell that is simulated as a whole.
            more = number < count and (number % len(jobs) > 0 or is_whole(open_cell.simulated))
            last = run(number, replace(before, more=more))
            # What its steps made is large, and in its folder.
            batch = replace(batch, runs=(*batch.runs, replace(last, results={}))).written()
            notify(Event("note", None, {"text": str(batch), "part": number, "count": count, "counts": batch.counts}))
            # Afterwards: whoever is told may have held the batch.
            before = _known_after(before, last, each_job=open_cell.config.calibration.each_job)
            interrupted = last.interrupted
            why = _ended_by(open_cell, job, last, number)
    except (CellError, SignalInterrupt) as error:
        if not batch.runs:
            raise
        why = f"after part {len(batch.runs)}: {error}"
        interrupted = isinstance(error, Interrupted | SignalInterrupt)
    rest = [jobs[k % len(jobs)].job.name for k in range(len(batch.runs), count)][: len(jobs)] if len(jobs) > 1 else ()
    why += f"; not tried: {', '.join(rest)}" * bool(rest)
    return replace(batch, reason=why or "every part was tried", interrupted=interrupted).written()


def _ended_by(open_cell: OpenCell, job: Job, last: RunOutcome, number: int) -> str:
    """Why no other part is begun after this end; empty where one is."""
    if last.interrupted or last.stopped_after_end or not (last.outcome in GOOD or _skipped(open_cell, job, last)):
        return f"part {number} {last}"
    return f"after part {number}, as asked" if last.control.end_batch else ""


def _still_known(before: PartsBefore, *, elsewhere: bool, asked: bool, refill: bool) -> PartsBefore:
    """What of it still holds for the next part. Whoever was `asked`, or sets the world up anew, may have moved vehicle
    and station, and bumped the scan head; the next stop is `elsewhere`."""
    if elsewhere or asked:
        before = replace(before, arrival=None, board=None)
    if asked:
        before = replace(before, look=None)
    return replace(before, arrival=None) if refill else before


def _known_after(before: PartsBefore, last: RunOutcome, *, each_job: bool) -> PartsBefore:
    """What parts tell of the next one; nothing after one that was refused, for whoever saw to it may have mended the
    fingers, changed the part, or moved the station."""
    if last.outcome not in GOOD:
        return PartsBefore()
    steps = drive_to_target, board_photo, place, verify
    arrival, photograph, put, seen = (last.results.get(step.STEP.name) for step in steps)
    series, stands = before.series, None
    if isinstance(seen, PlacedPart) and seen.came is not None:
        series = series.after(seen.came, seen.slips)
    board = None
    if isinstance(photograph, BoardFix) and not photograph.swung and not last.control.held_s:
        board = photograph
    if isinstance(arrival, VehicleArrival) and board is not None:
        stands = replace(arrival, shared=board)
    touch = put.touch.off if isinstance(put, PlaceResult) and put.touch is not None else None
    return PartsBefore(series, stands, board, _look_after(before, last, each_job), touch)


def _look_after(before: PartsBefore, last: RunOutcome, each_job: bool) -> HeadLook | None:
    """The look at the scan head that the next part may go by: none after a fault, for what was hit may sit elsewhere,
    where somebody held the run, for whoever did may have reached in, and where the fine board was to be seen at
    `each_job` and was not."""
    arrival, sweep = (last.results.get(step.STEP.name) for step in (drive_to_target, laser_sweep))
    if not isinstance(sweep, SweepRecord) or last.report.get("faults") or last.control.held_s:
        return None
    if sweep.looked_s:
        return before.look
    if each_job and not (isinstance(arrival, VehicleArrival) and arrival.head is not None):
        return None
    return HeadLook(float(sweep.times[0]), sweep.pointing, sweep.slip)


def _skipped(open_cell: OpenCell, job: Job, last: RunOutcome) -> bool:
    """Whether the batch goes on after this end: nobody knows how a part lies that is down and was refused."""
    there = PartState.first(job)
    untouched = last.report.get("part") == there.value and (job.nest is not None or open_cell.devices.claw.holding)
    return last.outcome == "refused" and untouched and job.batch.on_refusal != "end"


def _question(
    open_cell: OpenCell, job: Job, part: str, last: RunOutcome, *, refill: bool
) -> Callable[[WorkContext], None] | None:  # fmt: skip
    """What asks a person whether to go on after a refusal, and at a cell with real devices to `refill` it."""
    by_hand = refill and not is_whole(open_cell.simulated)
    refused = (
        last.outcome == "refused" and job.batch.on_refusal == "ask" and open_cell.config.cell.confirm != "simulated"
    )

    def work(context: WorkContext) -> None:
        if refused:
            context.ask(f"The last part was {last}. Go on with {part}?")
        if by_hand:
            _refill(open_cell, job, part, context)

    return work if refused or by_hand else None


def _refill(open_cell: OpenCell, job: Job, part: str, context: WorkContext) -> None:
    """A person makes the next part ready."""
    claw, simulated, ready = open_cell.devices.claw, open_cell.simulated, "and step back: the arm moves next"
    filled = simulated is not None and "claw" in simulated.simulated
    while job.nest is None and not (filled or claw.holding):
        context.ask(f"Hold {part} between the claw's fingers: the claw closes on it")
        try:
            claw.grip()
        except DeviceFault:
            claw.release()
    if job.nest is None:
        context.ask(f"The claw holds {part}; take away what was placed, prepare the next place, {ready}")
    elif job.item:
        context.ask(f"Take away what was placed, see that the parts lie where each item takes them from, {ready}")
    else:
        gone, lies = ("out of the nest", "on its surface") if job.unloads else ("from the station", "in its nest")
        context.ask(f"Take the last part {gone}, see that {part} lies {lies}, {ready}")

"""A batch: one job for several parts, a run each, and what came of them as counts and distributions.

Between two runs the next part comes into the claw. A simulated world puts it there by itself; at a real cell a person
does, who is asked in a recorded run of its own: nothing moves before that is confirmed.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean, stdev

from cell.base.storage import sealed, write_json
from cell.devices.devices import require_no_emergency_stop
from cell.devices.simulated.process import is_whole
from cell.run.folder import Report, when
from cell.run.job_run import RunOutcome
from cell.run.recorded_work import Hands, RecordedWork
from cell.run.runs import Run
from cell.run.session.session import Opened
from drivers.errors import CellError, ConfigError, DeviceFault, Interrupted
from drivers.interfaces import Claw

MOST_PARTS = 1_000_000
GOOD = ("placed", "done")
"""The ends of a part that was neither refused nor failed."""
COUNTED = ("placed", "corrected", "refused", "misplaced", "faulted", "aborted")
NEXT_PART = "batch.next_part"
"""The code of the questions between two parts."""


@dataclass(frozen=True)
class BatchPart:
    """A part of a batch, counted from 1: how the run of this name ended, and its figures by name, each with its unit.

    `part` is what has become of it: held, released or unknown. `corrections` counts how often it was placed again.
    """

    number: int
    outcome: str
    reason: str
    run: str
    part: str
    corrections: int
    figures: Mapping[str, tuple[float, str]]

    @classmethod
    def of(cls, number: int, outcome: RunOutcome) -> BatchPart:
        """As its run reports it."""
        report = outcome.report
        seen: Report = next((s["result"] for s in report.get("steps") or () if s["name"] == "verify"), None) or {}
        found: dict[str, tuple[float, str]] = {"cycle time": (report["cell_s"], "s")}
        if seen:
            found["placed part off its place, as seen"] = (seen["off_mm"], "mm")
            found["corrections"] = (len(seen["before_mm"]), "")
        if seen.get("gap"):
            found["gap, median"] = (seen["gap"]["median_mm"], "mm")
        rows = (row for row in report.get("measured") or () if row["value"] is not None)
        found |= {row["name"]: (row["value"], row["unit"]) for row in rows}
        state, corrections = str(report.get("part", "unknown")), len(seen.get("before_mm", ()))
        return cls(number, outcome.outcome, outcome.reason, outcome.folder.name, state, corrections, figures=found)


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
    """What came of a batch of `count` parts: those that were tried, and why it ended. `file` has it as JSON.

    `interrupted` says that a signal has ended it. `ended` is None while it goes on.
    """

    job: str
    count: int
    file: Path
    started: str
    ended: str | None
    reason: str
    interrupted: bool
    parts: tuple[BatchPart, ...]

    @property
    def counts(self) -> dict[str, int]:
        """How many parts ended how; one that was placed again before it was good counts as corrected, not as placed."""
        found = dict.fromkeys(COUNTED, 0)
        for part in self.parts:
            good = "corrected" if part.corrections else "placed"
            found[good if part.outcome in GOOD else part.outcome] += 1
        return {**found, "not tried": self.count - len(self.parts)}

    @property
    def figures(self) -> tuple[Distribution, ...]:
        """How each figure of the placed parts is distributed."""
        found: dict[tuple[str, str], list[float]] = {}
        for part in self.parts:
            for name, (value, unit) in part.figures.items() if part.outcome in GOOD else ():
                found.setdefault((name, unit), []).append(value)
        return tuple(
            Distribution(*which, len(of), fmean(of), stdev(of) if len(of) > 1 else None, min=min(of), max=max(of))
            for which, of in found.items()
        )

    @property
    def exit_code(self) -> int:
        """130 interrupted, else 0 when every part was placed, 1 otherwise."""
        return 130 if self.interrupted else int(self.counts["placed"] + self.counts["corrected"] < self.count)

    def as_dict(self) -> dict[str, object]:
        """JSON-ready."""
        figures = [asdict(figure) for figure in self.figures]
        return {**asdict(self), "file": self.file.name, "counts": self.counts, "figures": figures}


@dataclass(eq=False)
class BatchWork:
    """A batch at work: `run(number)` does a part's run, `between(work)` what is done between two parts, and waits.

    `on_part` is told each part, with the batch so far. `on_refusal` is the job's.
    """

    here: Opened
    job: str
    count: int
    on_refusal: str
    run: Callable[[int], RunOutcome]
    between: Callable[[Callable[[Run[None]], None]], None]
    on_part: Callable[[BatchPart, BatchOutcome], None]
    _parts: list[BatchPart] = field(default_factory=list)
    _started: float = field(default_factory=time.time)
    _id: str = field(default_factory=lambda: f"batch-{time.strftime('%Y%m%dT%H%M%S')}-{secrets.token_hex(2)}")

    def perform(self) -> BatchOutcome:
        """Do it. Raises what keeps the first part from being begun; later a signal or what `on_part` raises alone."""
        if not 1 <= self.count <= MOST_PARTS:
            raise ConfigError(f"a batch of {self.count} parts is none (allowed: 1 to {MOST_PARTS}); give another count")
        why, interrupted = "", False
        try:
            while not why and len(self._parts) < self.count:
                why, interrupted = self._part(len(self._parts) + 1)
        except BaseException as error:
            if not self._parts:
                raise
            signal = isinstance(error, Interrupted) or not isinstance(error, Exception)
            outcome = self._kept(f"after part {len(self._parts)}: {str(error) or type(error).__name__}", signal)
            if not isinstance(error, CellError):
                raise
            return outcome
        return self._kept(why or "every part was tried", interrupted)

    def _part(self, number: int) -> tuple[str, bool]:
        """Do the next part: why the batch ends after it, or nothing, and whether a signal came."""
        if number > 1:
            self._ask(number)
        outcome = self.run(number)
        part = BatchPart.of(number, outcome)
        self._parts.append(part)
        self.on_part(part, self._kept(None))
        # Nobody knows how a part lies that is down and was refused.
        skipped = part.outcome == "refused" and part.part == "held" and self.on_refusal != "end"
        if outcome.interrupted or outcome.stopped_after_end or not (part.outcome in GOOD or skipped):
            return f"part {number} {part.outcome}: {part.reason}", outcome.interrupted
        return "", False

    def _kept(self, why: str | None, interrupted: bool = False) -> BatchOutcome:
        """The batch so far, also in its file; with `why` it has ended."""
        ended, reason = (None, "not ended, or its process died") if why is None else (when(time.time()), why)
        outcome = BatchOutcome(
            self.job, self.count, self.here.runs_folder / f"{self._id}.json", when(self._started), ended,
            reason=reason, interrupted=interrupted, parts=tuple(self._parts),
        )  # fmt: skip
        write_json(outcome.file, sealed(outcome.as_dict()))
        return outcome

    def _ask(self, number: int) -> None:
        """Ask a person, in a run of its own, whether to go on after a refusal, and at a real cell for the next part."""
        here, last, simulated = self.here, self._parts[-1], self.here.simulated
        refused = last.outcome == "refused" and self.on_refusal == "ask" and here.config.cell.confirm != "simulated"
        by_hand = not is_whole(simulated)

        def work(hands: Hands) -> None:
            if refused:
                hands.ask(f"part {last.number} was refused: {last.reason}. Go on with part {number}?", NEXT_PART)
            if by_hand:
                filled = simulated is not None and "claw" in simulated.simulated
                load(hands, None if filled else here.devices.claw, f"part {number} of {self.count}")

        def recorded(run: Run[None]) -> None:
            facts = {**here.facts, "batch": self._id, "number": number}
            # Who reaches into the cell opens its guard: only an emergency stop ends this.
            health = require_no_emergency_stop
            RecordedWork(run, "loading", here.devices, here.runs_folder, facts, health=health).perform(work)

        if refused or by_hand:
            self.between(recorded)


def load(hands: Hands, claw: Claw | None, part: str) -> None:
    """Have a person put `part` into the claw, which closes once that is confirmed, and then clear the arm's way.

    Without a `claw` the simulated world fills it.
    """
    why = ""
    while claw is not None and not claw.holding:
        hands.ask(f"{why}Hold {part} between the claw's fingers: the claw closes on it", NEXT_PART)
        try:
            if not claw.holding:
                claw.grip()
        except DeviceFault as error:
            claw.release()
            why = f"{error} "
    ready = "take away what was placed, prepare the next place, and step back: the arm moves next"
    hands.ask(f"The claw holds {part}; {ready}", NEXT_PART)
    hands.safe_point()

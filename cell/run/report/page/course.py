"""The course of a run along its time, and how it stands among the runs of the same job before it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from cell.run.folder import Report, list_runs, read_report
from cell.run.report.page.activities import Activity, activities, idle
from drivers.errors import CellError
from statemachine.journal import JournalError, JournalRecord, read

SHOWN = ("confirm_needed", "confirmed", "paused", "going_on", "safe_stop")
"""Events of the journal that are marked, beside the faults."""
SECONDS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200)
MILLIMETRES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10)
"""Between two ticks of an axis."""
MOST_RUNS = 30
"""Runs that are shown, the newest."""


class Bar(NamedTuple):
    """An attempt at a step, from its begin to its end in seconds of the run."""

    step: str
    attempt: int
    begin: float
    end: float
    state: str


class TimelineMark(NamedTuple):
    """Something that happened, in seconds of the run; `bad` for a fault."""

    at: float
    text: str
    bad: bool


@dataclass(frozen=True)
class Timeline:
    """What is drawn, and which time it is told in."""

    bars: tuple[Bar, ...]
    marks: tuple[TimelineMark, ...]
    length: float
    clock: str
    activities: tuple[Activity, ...] = ()

    @property
    def steps(self) -> list[str]:
        """Names of the steps, in the order in which they began."""
        return list(dict.fromkeys(bar.step for bar in self.bars))

    @property
    def devices(self) -> list[str]:
        """Names of the devices that did something, in their order."""
        return list(dict.fromkeys(activity.device for activity in self.activities))

    @property
    def idle_s(self) -> float:
        """How long nothing moved, was lit or took pictures, s."""
        return sum(end - begin for begin, end in idle(self.activities, self.length))

    @property
    def ticks(self) -> list[float]:
        """Of the axis, s."""
        return _ticks(self.length, SECONDS, 10)


def timeline(folder: Path, report: Report) -> Timeline | None:
    """The course of a run by its journal; None where that tells no step.

    On the virtual clock the wall's time says nothing: the attempts' durations in the cell's time are laid end to end,
    and what the report calls a fault stands at the end of its attempt.
    """
    try:
        record = read(folder)
    except (JournalError, ValueError, TypeError):
        return None
    if not record.steps:
        return None
    course = _virtual(record, report) if report.get("clock") == "virtual" else _wall(record, report)
    # The record's time begins with the first step.
    first = min(bar.begin for bar in course.bars)
    rate = 1.0 if report.get("clock") == "virtual" else float(report.get("speed") or 1.0)
    moved = [one._replace(begin=one.begin + first, end=one.end + first) for one in activities(folder, rate)]
    return replace(course, activities=tuple(one for one in moved if first <= one.begin < one.end <= course.length))


def _wall(record: JournalRecord, report: Report) -> Timeline:
    start = record.run.started
    last = max(
        [record.run.ended or start, *(step.ended or step.started for step in record.steps)]
        + [event.at for event in record.events]
    )
    bars = [Bar(s.name, s.attempt, s.started - start, (s.ended or last) - start, s.state) for s in record.steps]
    marks = [TimelineMark(e.at - start, _told(e.kind, e.data), False) for e in record.events if e.kind in SHOWN]
    for fault in report.get("faults") or ():
        at = datetime.fromisoformat(str(fault["at"])).timestamp() - start
        marks.append(TimelineMark(min(max(at, 0.0), last - start), _fault(fault), True))
    return Timeline(tuple(bars), tuple(marks), max(last - start, 0.1), "on the wall")


def _virtual(record: JournalRecord, report: Report) -> Timeline:
    bars, now = [], 0.0
    for step in record.steps:
        length = step.duration_s or 0.0
        bars.append(Bar(step.name, step.attempt, now, now + length, step.state))
        now += length
    ends = {(bar.step, bar.attempt): bar.end for bar in bars}
    marks = [
        TimelineMark(ends.get((fault["step"], fault["attempt"]), now), _fault(fault), True)
        for fault in report.get("faults") or ()
    ]
    return Timeline(tuple(bars), tuple(marks), max(now, 0.1), "of the cell's clock")


def _told(kind: str, data: Mapping[str, Any]) -> str:
    what = data.get("reason") or data.get("text") or data.get("by") or ""
    return f"{kind.replace('_', ' ')}: {what}" if what else kind.replace("_", " ")


def _fault(fault: Mapping[str, Any]) -> str:
    return f"{fault.get('code')} in {fault.get('step')}: {fault.get('reason')} ({fault.get('remedy')})"


@dataclass(frozen=True)
class Past:
    """A run of the job: its largest true place error where that is known, and what it states, in mm."""

    name: str
    started: str
    outcome: str
    simulated: bool
    true_mm: float | None
    stated_mm: float | None

    def __str__(self) -> str:
        true = "" if self.true_mm is None else f", true error {self.true_mm:.3f} mm"
        stated = "" if self.stated_mm is None else f", stated {self.stated_mm:.3f} mm"
        return f"{self.name}, {self.started}, {self.outcome}{true}{stated}{', simulated' if self.simulated else ''}"


@dataclass(frozen=True)
class Trend:
    """The runs, oldest first, with the job's tolerance where it is known."""

    runs: Sequence[Past]
    tolerance_mm: float | None

    @property
    def highest(self) -> float:
        """End of the axis, mm."""
        values = [value for run in self.runs for value in (run.true_mm, run.stated_mm) if value is not None]
        return 1.1 * max([*values, self.tolerance_mm or 0.0, 1e-3])

    @property
    def ticks(self) -> list[float]:
        """Of the axis, mm."""
        return _ticks(self.highest, MILLIMETRES, 6)


def past_runs(folder: Path, report: Report) -> list[Past]:
    """The runs of the same job beside `folder` that began before it, and itself at the end; what cannot be read is left
    out."""
    found = []
    names = [run for run in list_runs(folder.parent) if run.name < folder.name]
    for run in reversed(names):
        try:
            told = read_report(run)
        except (CellError, OSError):
            continue
        if told.get("kind", "job") == "job" and told.get("job") == report.get("job"):
            found.append(_past(run.name, told))
        if len(found) == MOST_RUNS - 1:
            break
    return [*reversed(found), _past(folder.name, report)]


def _past(name: str, report: Report) -> Past:
    truth, bound = report.get("truth"), report.get("place_bound_95")
    return Past(
        name, str(report.get("started") or "")[:16].replace("T", " "), str(report["outcome"]),
        simulated=bool(report.get("simulated")),
        true_mm=None if truth is None else float(truth["error_mm"]["d"]["max"]),
        stated_mm=None if bound is None else float(bound["d"]),
    )  # fmt: skip


def _ticks(end: float, steps: Sequence[float], most: int) -> list[float]:
    """Ticks from 0 to `end`, hardly more than `most`, at one of the `steps` where that will do."""
    step = next((step for step in steps if end / step <= most), end / (most - 2))
    return [k * step for k in range(int(end / step) + 1)]

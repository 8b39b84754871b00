"""The course of a run along its time, what each device did meanwhile, and how it stands among the runs before it."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from cell.run.folder import Report, list_runs, read_report
from cell.run.record.file import CAMERAS, FILE, missing
from cell.run.record.reading import messages
from drivers.errors import CellError
from statemachine.journal import JournalError, JournalRecord, read

LANES = {
    "vehicle": "drives", "arm": "moves", "rail": "moves", "laser": "is lit", "scan_camera": "takes pictures",
    "target_camera": "takes pictures", "claw": "is told",
}  # fmt: skip
"""Devices in the order in which they are drawn, and what a bar of each says."""
MOVING = 1e-3
"""Rad/s of a joint, m/s or rad/s of the vehicle, above which it moves."""
RAIL_M_S = 0.04
"""How fast the rail goes where no speed is told: as `rail.max_speed` is shipped."""
SWITCH_S = 1.0
"""What the rail takes over its reference switch."""
APART_S = 0.5
"""Pictures farther apart are of two looks."""
SHORTEST_S = 0.02
"""A bar of an instant, such as one picture, is so long."""

State: TypeAlias = Mapping[str, object]


class Activity(NamedTuple):
    """A device was busy from `begin` to `end`, s since the first step began. `first` and `last` are its states then."""

    device: str
    begin: float
    end: float
    pictures: int = 0
    first: State | None = None
    last: State | None = None

    @property
    def words(self) -> str:
        """For people."""
        many = f", {self.pictures}" if self.pictures else ""
        return f"{self.device} {LANES[self.device]}{many}, {self.end - self.begin:.2f} s"


@dataclass(frozen=True)
class _Told:
    at: float
    state: State


def activities(folder: Path, rate: float = 1.0) -> list[Activity]:
    """What the devices did in the run in `folder`, in the order of the devices and of the time; empty where no record
    tells it. The cell went `rate` times as fast as the record's time."""
    if missing() or not (folder / FILE).is_file():
        return []
    try:
        begun, told = _read(folder / FILE)
    except (CellError, KeyError):
        return []
    found: list[Activity] = []
    last = max((one.at for each in told.values() for one in each), default=begun)
    for device in LANES:
        states, commands, frames = (told.get(f"/{device}/{what}", []) for what in ("state", "command", "frame"))
        if device in CAMERAS:
            found += _looks(device, frames)
        elif device in ("laser", "claw"):
            found += _switched(device, commands, last)
        elif device == "rail":
            found += _rail_moves(states, commands, rate)
        else:
            found += _moves(device, states, _arm_moves if device == "arm" else _vehicle_moves)
    return [one._replace(begin=one.begin - begun, end=one.end - begun) for one in found]


def _read(record: Path) -> tuple[float, dict[str, list[_Told]]]:
    """When the first step began, s, and what was told from then on, by topic; nothing where none began."""
    told: dict[str, list[_Told]] = {}
    begun: float | None = None
    for topic, at, message in messages(record, ("/sequence/event", *(f"/{device}/" for device in LANES))):
        if not isinstance(message, dict):
            continue
        if begun is None and topic == "/sequence/event" and message.get("kind") == "step_started":
            begun = 1e-9 * at
        elif not message.get("refused"):
            told.setdefault(topic, []).append(_Told(1e-9 * at, message))
    return (0.0, {}) if begun is None else (begun, told)


def idle(busy: Iterable[Activity], length: float) -> list[tuple[float, float]]:
    """From when to when, s, no device moves, is lit or takes pictures, in a run of `length` s."""
    gaps, until = list[tuple[float, float]](), 0.0
    for activity in sorted(busy, key=lambda one: one.begin):
        if activity.begin > until:
            gaps.append((until, activity.begin))
        until = max(until, activity.end)
    return [*gaps, (until, length)] if length > until else gaps


def _moves(device: str, states: Sequence[_Told], moving: Callable[[State], bool]) -> list[Activity]:
    """Of a device whose states come all the time: from the last state at rest to the next one."""
    found: list[Activity] = []
    begun: _Told | None = None
    for before, now in pairwise(sorted(states, key=lambda told: told.at)):
        if moving(now.state):
            begun = begun or before
        elif begun is not None:
            found.append(Activity(device, begun.at, before.at, first=begun.state, last=before.state))
            begun = None
    if begun is not None:
        found.append(Activity(device, begun.at, now.at, first=begun.state, last=now.state))
    return found


def _number(state: State, name: str) -> float:
    value = state.get(name)
    return float(value) if isinstance(value, int | float) else 0.0


def _arm_moves(state: State) -> bool:
    speeds = state.get("joint_speeds")
    return isinstance(speeds, list) and bool(np.abs(np.array(speeds, dtype=np.float64)).max(initial=0.0) > MOVING)


def _vehicle_moves(state: State) -> bool:
    return max(abs(_number(state, name)) for name in ("speed", "yaw_rate")) > MOVING


def _rail_moves(states: Sequence[_Told], commands: Sequence[_Told], rate: float) -> list[Activity]:
    """From each command until its way is done, or something newer is told: at rest the rail is asked now and then."""
    sent = [one for one in commands if one.state.get("name") in ("home", "move_to", "sweep")]
    rests = [one.at for one in states if "homed" in one.state]
    found: list[Activity] = []
    stands = 0.0
    for k, command in enumerate(sent):
        given = command.state.get("arguments")
        given = given if isinstance(given, dict) else {}
        goal = _number(given, "stop" if "stop" in given else "position")
        # A look for the reference switch is told as a way to 0.
        way = abs(goal - stands) / (_number(given, "speed") or RAIL_M_S)
        longest = (way + (SHORTEST_S if goal else SWITCH_S)) / rate
        newer = [at for at in rests if at > command.at + SHORTEST_S][:1] + [one.at for one in sent[k + 1 : k + 2]]
        until = min(newer, default=command.at + longest)
        found.append(Activity("rail", command.at, until if "stop" in given else min(until, command.at + longest)))
        stands = goal
    return found


def _looks(device: str, frames: Sequence[_Told]) -> list[Activity]:
    found: list[Activity] = []
    for frame in frames:
        if found and frame.at - found[-1].end < APART_S:
            found[-1] = found[-1]._replace(end=frame.at, pictures=found[-1].pictures + 1)
        else:
            found.append(Activity(device, frame.at, frame.at + SHORTEST_S, pictures=1))
    return found


def _switched(device: str, commands: Sequence[_Told], last: float) -> list[Activity]:
    """The laser from each time it is lit until it is off, or until the record's `last` time; of a claw each command."""
    if device == "claw":
        return [Activity(device, command.at, command.at + SHORTEST_S) for command in commands]
    found: list[Activity] = []
    lit: float | None = None
    for command in commands:
        on = command.state.get("name") == "lit"
        if on and lit is None:
            lit = command.at
        elif not on and lit is not None:
            found.append(Activity(device, lit, command.at))
            lit = None
    return found if lit is None else [*found, Activity(device, lit, last)]


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

"""Many schedules: at random first, then those that reach what was not reached; what breaks a rule is shrunk.

Each runs in a process of its own pool with the calibration of its cell, which is made once for all of them.
"""

import itertools
import math
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cell.config.job import item_names, load_job
from cell.procedures.steps.kinds import kind_of
from lab.bench.over_cores import Task, over_cores
from lab.bench.schedules.day import DayRecord, calibrate, perform
from lab.bench.schedules.oracle import Violation
from lab.bench.schedules.schedule import ACTS, Schedule, draw
from lab.bench.schedules.shrink import shrunk
from sim_backends.direct.cell import NAMES as FAULTS

MOST_SEEDS, SCHEDULES_A_SEED = 10, 25
"""So many worlds are drawn at most: a calibration costs as much as several jobs."""
BATCHES = (0.5, 0.75, 1.0)
"""The first share is drawn at random, each further one by what was not reached until then."""

Told = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and of how much."""
World = tuple[int, str]
Place = tuple[str, str]
"""A step, "" before the first, and an act."""


def steps_of(jobs: Iterable[str]) -> list[tuple[str, tuple[str, ...]]]:
    """Each job, or each item of one that has several, with the names of its steps."""
    names = [name for job in jobs for name in item_names(job)]
    return [(name, kind_of(load_job(name)[0]).names) for name in names]


def campaign(
    jobs: Sequence[str], levels: Sequence[str], count: int, first_seed: int, folder: Path, workers: int, told: Told
) -> dict[str, Any]:
    """Run `count` schedules from `first_seed` on and sum up; calibrations are kept in `folder`."""
    drawn_of = steps_of(jobs)
    seeds = range(1, min(MOST_SEEDS, math.ceil(count / SCHEDULES_A_SEED)) + 1)
    stored = calibrated([(seed, level) for level in levels for seed in seeds], folder, workers, told)
    records: list[DayRecord] = []
    for share in BATCHES:
        reached = Counter((step, act) for record in records for step, act, _ in record.met)
        numbers = range(len(records), round(share * count))
        drawn = [draw(first_seed + n, drawn_of, levels, seeds, partial(_wanted, reached)) for n in numbers]
        records += days(drawn, stored, workers, told)
    broken = [(record.schedule, record.violations[0]) for record in records if record.violations]
    for schedule, violation in broken:
        told(f"schedules; to be shrunk: {violation}; {command(schedule)}", len(records), count)
    smallest = _each([(_shrink, *each, stored) for each in broken], workers, partial(told, "shrunk"))
    return {**summary(records, drawn_of), "violations": smallest}


def repeated(schedules: Sequence[Schedule], folder: Path, workers: int, told: Told) -> dict[str, Any]:
    """Run these schedules, and sum up; nothing is shrunk."""
    stored = calibrated(sorted({(each.seed, each.level) for each in schedules}), folder, workers, told)
    records = days(schedules, stored, workers, told)
    broken = [_told_of(record.schedule, each) for record in records for each in record.violations]
    ends = [{"schedule": record.schedule.as_json(), "ends": [list(end) for end in record.ends]} for record in records]
    return {**summary(records, steps_of([each.job for each in schedules])), "days": ends, "violations": broken}


def calibrated(worlds: Sequence[World], folder: Path, workers: int, told: Told) -> dict[World, Path]:
    """Where the calibration of each world is kept in `folder`."""
    tasks = [(calibrate, seed, level, folder / f"{level}-{seed}") for seed, level in worlds]
    return dict(zip(worlds, _each(tasks, workers, partial(told, "calibrated")), strict=True))


def days(schedules: Sequence[Schedule], stored: dict[World, Path], workers: int, told: Told) -> list[DayRecord]:
    """The record of each schedule, in their order."""
    tasks = [(one_day, each, stored[each.seed, each.level]) for each in schedules]
    return _each(tasks, workers, partial(told, "schedules"))


def _each(tasks: Sequence[Task], workers: int, told: Callable[[int, int], None]) -> list[Any]:
    """What each task makes, in their order; `told` how many have ended."""
    number = itertools.count(1)
    return over_cores(tasks, workers, lambda made: told(next(number), len(tasks)))


def one_day(schedule: Schedule, calibrations: Path) -> DayRecord:
    """The day of a schedule; what it raises breaks a rule as well, for a run's end is told and not raised."""
    try:
        return perform(schedule, calibrations)
    except Exception as error:
        raised = Violation("raised", 0.0, f"{type(error).__name__}: {error}")
        return DayRecord(schedule, (), (), (raised,))


def summary(records: Sequence[DayRecord], drawn_of: Sequence[tuple[str, tuple[str, ...]]]) -> dict[str, Any]:
    """How often which act met which step and how the run ended then, and which never met."""
    counts: dict[Place, Counter[str]] = {}
    for record in records:
        for step, act, outcome in record.met:
            counts.setdefault((step, act), Counter())[outcome] += 1
    steps = dict.fromkeys(step for _, names in drawn_of for step in names)
    never = {step: [act for act in (*FAULTS, *ACTS) if (step, act) not in counts] for step in steps}
    outcomes = Counter(outcome for record in records for outcome, _ in record.ends)
    met = [{"step": step or "before", "act": act, **counts[step, act]} for step, act in sorted(counts)]
    return {
        "schedules": len(records), "runs": sum(len(record.ends) for record in records), "outcomes": dict(outcomes),
        "met": met, "never_met": {step: ", ".join(acts) for step, acts in never.items() if acts},
    }  # fmt: skip


def command(schedule: Schedule) -> str:
    """What repeats a schedule."""
    return f"cell bench schedules --schedule {shlex.quote(schedule.as_json())}"


def _wanted(reached: Counter[Place], step: str, act: str) -> float:
    """What was seldom reached is drawn more often."""
    return 1.0 / (1.0 + reached[step, act]) ** 2


def _shrink(schedule: Schedule, violation: Violation, stored: dict[World, Path]) -> dict[str, str]:
    """The smallest schedule that breaks the same rule, as it is told."""
    last = {schedule: violation}

    def breaks(smaller: Schedule) -> bool:
        if (where := stored.get((smaller.seed, smaller.level))) is None:
            return False
        found = [each for each in one_day(smaller, where).violations if each.rule == violation.rule]
        if found:
            last[smaller] = found[0]
        return bool(found)

    smallest = shrunk(schedule, breaks)
    return _told_of(smallest, last[smallest])


def _told_of(schedule: Schedule, violation: Violation) -> dict[str, str]:
    return {"rule": violation.rule, "how": str(violation), "schedule": schedule.as_json(), "command": command(schedule)}

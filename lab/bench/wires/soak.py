"""Jobs one after the other over the wires at the wall's speed: does anything grow that a month would not bear?

Counted after each job, for this process and each that it has started: memory, threads, open handles. Growth is the
median slope between all pairs of jobs after the first ones, so that one odd job does not make it.
"""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
from scipy.stats import theilslopes

from cell.run.session.supervisor import Cell
from drivers.errors import Aborted, CalibrationStale, CellError, ConfigError

WARM_UP = 2
"""Jobs that are not counted: caches fill, compiled code is loaded."""
PAUSE_S = 5.0
"""Of the clock, before the next try of a job that could not be begun."""
LEAST = 3
"""Jobs after those that a verdict needs."""
MOST_GROWTH = {"memory_mb": 0.5, "threads": 0.1, "handles": 0.1}
"""What each process may grow by, a job. Half a megabyte is 1 GB in 2000 jobs."""


def soak(
    minutes: float, seed: int, job: str, progress: Callable[[float, str], None], speed: float = 1.0
) -> dict[str, Any]:
    """Repeat the job for `minutes` on the wall, at least once; what was counted, the growth and a verdict."""
    until, begun = time.monotonic() + 60.0 * minutes, time.monotonic()
    rows: list[dict[str, Any]] = []
    with Cell.open(sim="all", seed=seed, speed=speed, job=job, confirm="simulated") as cell:
        try:
            cell.calibration()
        except CalibrationStale:
            progress(0.0, "calibration")
            cell.calibrate(job=job)
        while not rows or time.monotonic() < until:
            outcome, reason = _job(cell, job)
            rows.append({
                "job": len(rows) + 1, "outcome": outcome, "reason": reason,
                "minutes": round((time.monotonic() - begun) / 60.0, 2), "processes": counted(os.getpid()),
            })  # fmt: skip
            if outcome == "aborted":
                # Somebody wants the end.
                break
            progress(min(1.0, (time.monotonic() - begun) / (60.0 * minutes)), f"job {len(rows)}: {outcome}")
    growth = growth_of(rows)
    return {"speed": speed, "jobs": rows, "growth_a_job": growth, "limits": MOST_GROWTH, "verdict": verdict(growth)}


def _job(cell: Cell, job: str) -> tuple[str, str]:
    """Outcome and reason of one job; one that could not be begun, on a busy machine, is a job that faulted."""
    try:
        outcome = cell.run(job, at_start=True)
    except (Aborted, ConfigError):
        raise
    except CellError as error:
        # Whatever was late is given a moment.
        cell.devices.clock.sleep(PAUSE_S)
        return "not begun", " ".join(str(error).split())
    return outcome.outcome, outcome.reason


def counted(owner: int) -> dict[str, dict[str, float]]:
    """Memory (resident, MB), threads and open handles of a process and of all that it has started, by what they are."""
    found: dict[str, dict[str, float]] = {}
    top = psutil.Process(owner)
    for process in [top, *top.children(recursive=True)]:
        # One may just have ended.
        with suppress(psutil.NoSuchProcess):
            name = "this program" if process == top else _name(process.cmdline())
            memory, threads, handles = process.memory_info().rss / 2**20, process.num_threads(), process.num_fds()
            row = found.setdefault(name, dict.fromkeys(MOST_GROWTH, 0.0))
            for key, value in zip(MOST_GROWTH, (memory, threads, handles), strict=True):
                row[key] += value
    return found


def _name(words: list[str]) -> str:
    """What a process is: the module that it runs."""
    script = next((word for word in words if word.endswith(".py")), words[0] if words else "")
    return words[words.index("-m") + 1] if "-m" in words else Path(script).name


def descendants(owner: int) -> list[int]:
    """All processes that `owner` has started, and those that they have."""
    return sorted(process.pid for process in psutil.Process(owner).children(recursive=True))


def growth_of(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """What each process grows by, a job; nothing of less than `LEAST` jobs after the first ones."""
    kept = rows[WARM_UP:]
    if len(kept) < LEAST:
        return {}
    names = set.intersection(*(set(row["processes"]) for row in kept))
    return {
        name: {key: float(theilslopes([row["processes"][name][key] for row in kept])[0]) for key in MOST_GROWTH}
        for name in sorted(names)
    }


def verdict(growth: dict[str, dict[str, float]]) -> str:
    """In words."""
    if not growth:
        return f"none: at least {WARM_UP + LEAST} jobs are needed"
    grown = [
        f"{name}: {key} {value:+.2f} a job (allowed {MOST_GROWTH[key]:g})"
        for name, row in growth.items()
        for key, value in row.items()
        if value > MOST_GROWTH[key]
    ]
    return "grows: " + "; ".join(grown) if grown else "nothing grows"

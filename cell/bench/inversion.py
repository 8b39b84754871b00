"""The campaign behind `cell bench inversion`: starts from near and far on every part, ours beside the peers.

A task is one part and one seed; cloud and starts are the same for every method. Times are CPU times of one thread, so
that a busy machine changes them little.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np

from cell.bench.inversion_methods import Method, methods
from cell.bench.inversion_parts import PARTS, nominal
from cell.bench.inversion_scenes import SETTINGS, TRUE, scan, start_away
from cell.inversion import Prior
from cell.inversion.registration import Scan
from drivers.errors import RefusedError

STARTS = {"far": (0.008, 20.0), "near": (0.003, 0.8)}
"""Where the search begins: m and degrees from the true pose; the prior's standard deviations are the same."""
CONVERGED = (0.0002, 0.004)
"""A pose this near to the true one, m and rad, is found: no noise reaches so far, and no local minimum lies so near."""


@dataclass(frozen=True)
class Outcome:
    """One registration: `error` in m and rad of what the part determines (infinite if it gave up), CPU time in s."""

    part: str
    setting: str
    start: str
    method: str
    error: tuple[float, float]
    seconds: float

    @property
    def converged(self) -> bool:
        """True when the pose is the true one."""
        return self.error[0] < CONVERGED[0] and self.error[1] < CONVERGED[1]


def prior(kind: str, rng: np.random.Generator) -> Prior:
    """A start of the `kind` in a random direction, as uncertain as it is wrong."""
    metres, degrees = STARTS[kind]
    spread = np.diag([metres**2] * 3 + [np.radians(degrees) ** 2] * 3)
    return Prior(start_away(rng, metres, degrees), spread)


@cache
def ready(part: str, peers: bool) -> dict[str, Method | str]:
    """The methods for a part, made and compiled once in each process."""
    found = methods(nominal(part), peers)
    rng = np.random.default_rng(0)
    cloud, begin = Scan.of(scan(PARTS[part], rng), 2000), prior("near", rng)
    for run in found.values():
        if not isinstance(run, str):
            run(cloud, begin)
    return found


def task(part: str, seed: int, peers: bool) -> list[Outcome]:
    """Both starts and every method on one part; the setting goes round with the seed."""
    label = list(SETTINGS)[seed % len(SETTINGS)]
    rng = np.random.default_rng(seed)
    cloud = Scan.of(scan(PARTS[part], rng, SETTINGS[label]))
    outcomes = []
    for kind in STARTS:
        begin = prior(kind, rng)
        for method, run in ready(part, peers).items():
            if isinstance(run, str):
                continue
            started = time.process_time()
            try:
                error = PARTS[part].error(run(cloud, begin), TRUE)
            except (RefusedError, RuntimeError, ValueError):
                error = (float("inf"), float("inf"))
            outcomes.append(Outcome(part, label, kind, method, error, time.process_time() - started))
    return outcomes


def table(outcomes: Iterable[Outcome]) -> list[dict[str, object]]:
    """One row for each part, start and method: share converged (%), errors of those (mm, mrad), median time (ms) and
    its ratio to ours.
    """
    groups: dict[tuple[str, str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[outcome.part, outcome.start, outcome.method].append(outcome)
    rows: list[dict[str, object]] = []
    for (part, start, method), group in groups.items():
        good = np.array([o.error for o in group if o.converged]) if any(o.converged for o in group) else None
        ms = 1e3 * float(np.median([o.seconds for o in group]))
        ours = 1e3 * float(np.median([o.seconds for o in groups[part, start, "ours"]]))
        row: dict[str, object] = {"part": PARTS[part].title, "start": start, "method": method, "starts": len(group)}
        row["converged_percent"] = round(100 * sum(o.converged for o in group) / len(group), 1)
        for column, unit in enumerate(("mm", "mrad")):
            values = None if good is None else 1e3 * good[:, column]
            row[f"mean_{unit}"] = None if values is None else round(float(values.mean()), 4)
            row[f"p95_{unit}"] = None if values is None else round(float(np.percentile(values, 95)), 4)
        rows.append(row | {"ms": round(ms, 1), "ratio": round(ms / ours, 2)})
    return rows

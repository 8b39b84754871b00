"""The campaign behind `cell bench inversion`: starts from near and far on every part, ours beside the peers.

A task is one part and one seed; cloud and starts are the same for every method, and the peers, which take most of the
time, get every second round of the settings. Times are CPU times of one thread, so that a busy machine changes them
little.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np

from cell.inversion import Prior
from cell.inversion.correspondences import Scan
from cell.lab.bench.inversion_methods import OURS, Method, methods
from cell.lab.bench.inversion_parts import PARTS, nominal
from cell.lab.bench.inversion_scenes import SETTINGS, TRUE, scan, start_away
from drivers.errors import RefusedError

STARTS = {"far": (0.008, 20.0), "near": (0.003, 0.8)}
"""Where the search begins: m and degrees from the true pose; the prior's standard deviations are the same."""
CONVERGED = (0.0002, 0.004)
"""A pose this near to the true one, m and rad, is found: no noise reaches so far, and no local minimum lies so near."""


@dataclass(frozen=True)
class Outcome:
    """One registration: `error` in m and rad of what the part determines (infinite if it gave up), CPU time in s."""

    part: str
    seed: int
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


def not_run(peers: bool) -> dict[str, str]:
    """Why a method is not shown, by its name."""
    return {name: run for name, run in ready("cap", peers).items() if isinstance(run, str)}


def task(part: str, seed: int, peers: bool) -> list[Outcome]:
    """Both starts and every method on one part; the setting goes round with the seed."""
    rounds, turn = divmod(seed, len(SETTINGS))
    label = list(SETTINGS)[turn]
    rng = np.random.default_rng(seed)
    cloud = Scan.of(scan(PARTS[part], rng, SETTINGS[label]))
    outcomes = []
    for kind in STARTS:
        begin = prior(kind, rng)
        for method, run in ready(part, peers).items():
            if isinstance(run, str) or (method != OURS and rounds % 2):
                continue
            started = time.process_time()
            try:
                error = PARTS[part].error(run(cloud, begin), TRUE)
            except (RefusedError, RuntimeError, ValueError):
                error = (float("inf"), float("inf"))
            outcomes.append(Outcome(part, seed, label, kind, method, error, time.process_time() - started))
    return outcomes


def table(outcomes: Iterable[Outcome]) -> list[dict[str, object]]:
    """One row for each part, start and method, and for all parts together."""
    groups: dict[tuple[str, str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[PARTS[outcome.part].title, outcome.start, outcome.method].append(outcome)
    for (_, start, method), group in list(groups.items()):
        groups["all parts", start, method] += group
    return [
        {"part": part, "start": start, "method": method, **_figures(group, groups[part, start, OURS])}
        for (part, start, method), group in groups.items()
    ]


def _figures(group: list[Outcome], ours: list[Outcome]) -> dict[str, object]:
    """Share converged (%), errors of those (mm, mrad), median time (ms) and its ratio to ours in the same tasks."""
    found = 1e3 * np.array([o.error for o in group if o.converged]).reshape(-1, 2)
    row: dict[str, object] = {"starts": len(group), "converged_percent": _percent(group)}
    for column, unit in enumerate(("mm", "mrad")):
        for name, share in (("median", 50), ("p95", 95)):
            row[f"{name}_{unit}"] = round(float(np.percentile(found[:, column], share)), 4) if len(found) else None
    beside = {(o.part, o.seed): o.seconds for o in ours}
    ratio = np.median([o.seconds / beside[o.part, o.seed] for o in group])
    row |= {"ms": round(1e3 * float(np.median([o.seconds for o in group])), 1), "ratio": round(float(ratio), 2)}
    settings = {label: [o for o in group if o.setting == label] for label in SETTINGS}
    return row | {"converged_percent_by_setting": {k: _percent(some) for k, some in settings.items() if some}}


def _percent(group: list[Outcome]) -> float:
    return round(100 * sum(o.converged for o in group) / len(group), 1)

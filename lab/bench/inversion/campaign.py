"""The campaign behind `cell bench inversion`: starts from near and far on every part.

A task is one part and one seed. Times are CPU times of one thread, so that a busy machine changes them little. What
small_gicp and Open3D made of the same clouds and starts is in docs/explanation/libraries.md.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from cell.measure.inversion import Prior
from cell.measure.inversion.nominal import Scan
from cell.measure.inversion.registration import register
from drivers.errors import RefusedError
from lab.bench.inversion.parts import PARTS, nominal
from lab.bench.inversion.scenes import SETTINGS, TRUE, scan, start_away

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


def task(part: str, seed: int) -> list[Outcome]:
    """Both starts on one part; the setting goes round with the seed."""
    label = list(SETTINGS)[seed % len(SETTINGS)]
    rng = np.random.default_rng(seed)
    cloud = Scan.of(scan(PARTS[part], rng, SETTINGS[label]))
    outcomes = []
    for kind in STARTS:
        begin = prior(kind, rng)
        started = time.process_time()
        try:
            error = PARTS[part].error(register(cloud, nominal(part), begin).base_from_surface, TRUE)
        except RefusedError:
            error = (float("inf"), float("inf"))
        outcomes.append(Outcome(part, seed, label, kind, error, time.process_time() - started))
    return outcomes


def table(outcomes: Iterable[Outcome]) -> list[dict[str, object]]:
    """One row for each part and start, and for all parts together."""
    groups: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        for part in (PARTS[outcome.part].title, "all parts"):
            groups[part, outcome.start].append(outcome)
    ordered = sorted(groups.items(), key=lambda item: item[0][0] == "all parts")
    return [{"part": part, "start": start, **_figures(group)} for (part, start), group in ordered]


def _figures(group: list[Outcome]) -> dict[str, object]:
    """Share converged (%), errors of those (mm, mrad) and the median time (ms)."""
    found = 1e3 * np.array([o.error for o in group if o.converged]).reshape(-1, 2)
    row: dict[str, object] = {"starts": len(group), "converged_percent": _percent(group)}
    for column, unit in enumerate(("mm", "mrad")):
        for name, share in (("median", 50), ("p95", 95)):
            row[f"{name}_{unit}"] = round(float(np.percentile(found[:, column], share)), 4) if len(found) else None
    row["ms"] = round(1e3 * float(np.median([o.seconds for o in group])), 1)
    settings = {label: [o for o in group if o.setting == label] for label in SETTINGS}
    return row | {"converged_percent_by_setting": {k: _percent(some) for k, some in settings.items() if some}}


def _percent(group: list[Outcome]) -> float:
    return round(100 * sum(o.converged for o in group) / len(group), 1)

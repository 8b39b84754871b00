"""The campaign behind `cell bench inversion`: starts from near and far on every part, and scans to be refused.

A task is one part and one seed. Times are CPU times of one thread, so that a busy machine changes them little. What
small_gicp and Open3D made of the same clouds and starts is in docs/explanation/libraries.md.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from cell.measure.inversion import Prior
from cell.measure.inversion.closest import Array
from cell.measure.inversion.nominal import Scan
from cell.measure.inversion.registration import register
from drivers.errors import RefusedError
from lab.bench.inversion.parts import PARTS, nominal
from lab.bench.inversion.refusals import CASES, Judged, coverage, judge_case
from lab.bench.inversion.scenes import RAIL_SIGMA, SETTINGS, STRIPE_SIGMA, TRUE, scan, start_away
from lab.bench.over_cores import Progress, Task, run_all

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


def campaign(starts: int, cases: int, progress: Progress) -> dict[str, object]:
    """Rows of `registration`, of `refusals` and the figures of `coverage`."""
    tasks: list[Task] = [(task, part, seed) for seed in range(starts) for part in PARTS]
    tasks += [(judge_case, case, seed) for case in CASES for seed in range(cases)]
    tasks += [(coverage, seed) for seed in range(5 * cases)]
    found = run_all(_run, tasks, progress=progress)
    outcomes = [outcome for made in found if isinstance(made, list) for outcome in made]
    judged = [made for made in found if isinstance(made, Judged)]
    order = {part: k for k, part in enumerate(PARTS)}
    outcomes.sort(key=lambda outcome: (order[outcome.part], outcome.start, outcome.seed))
    return {
        "registration": table(outcomes),
        "refusals": [_case_row(case, [j for j in judged if j.case == case]) for case in CASES],
        "coverage": _coverage([made for made in found if isinstance(made, tuple)]),
        "assumed_noise": {"stripe_mm": 1e3 * STRIPE_SIGMA, "rail_mm": 1e3 * RAIL_SIGMA, "wild_points_percent": 1.0},
    }


def _run(task: Task) -> Any:
    return task[0](*task[1:])


def _case_row(case: str, judged: list[Judged]) -> dict[str, object]:
    ended = Counter(j.ended for j in judged)
    errors = [j.error for j in judged if j.error is not None]
    reasons = sorted(j.reason for j in judged if j.reason)
    return {
        "case": case,
        **{end: ended[end] for end in ("within", "refused", "outside")},
        "worst_mm": round(1e3 * max(e[0] for e in errors), 3) if errors else None,
        "worst_mrad": round(1e3 * max(e[1] for e in errors), 2) if errors else None,
        "reason": reasons[0] if reasons else None,
    }


def _coverage(scores: list[tuple[Array, float]]) -> dict[str, object]:
    z = np.array([score for score, _ in scores])
    held = np.mean([distance < chi2.ppf(0.95, 6) for _, distance in scores])
    return {
        "scans": len(scores),
        "ellipsoid_95_percent": round(100 * float(held), 1),
        "z_score_rms": [round(float(v), 3) for v in np.sqrt(np.mean(z**2, axis=0))],
    }

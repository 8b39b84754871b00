"""Runs the inversion's campaigns on all cores and gathers what they show."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from scipy.stats import chi2

from cell.measure.inversion.closest import Array
from lab.bench.inversion import refusals
from lab.bench.inversion.campaign import table, task
from lab.bench.inversion.parts import PARTS
from lab.bench.inversion.scenes import RAIL_SIGMA, STRIPE_SIGMA
from lab.bench.over_cores import Progress, Task, run_all


def campaign(starts: int, cases: int, progress: Progress) -> dict[str, object]:
    """Rows of `registration`, of `refusals` and the figures of `coverage`."""
    tasks: list[Task] = [(task, part, seed) for seed in range(starts) for part in PARTS]
    tasks += [(refusals.judge_case, case, seed) for case in refusals.CASES for seed in range(cases)]
    tasks += [(refusals.coverage, seed) for seed in range(5 * cases)]
    found = run_all(_run, tasks, progress=progress)
    outcomes = [outcome for made in found if isinstance(made, list) for outcome in made]
    judged = [made for made in found if isinstance(made, refusals.Judged)]
    order = {part: k for k, part in enumerate(PARTS)}
    outcomes.sort(key=lambda outcome: (order[outcome.part], outcome.start, outcome.seed))
    return {
        "registration": table(outcomes),
        "refusals": [_case_row(case, [j for j in judged if j.case == case]) for case in refusals.CASES],
        "coverage": _coverage([made for made in found if isinstance(made, tuple)]),
        "assumed_noise": {"stripe_mm": 1e3 * STRIPE_SIGMA, "rail_mm": 1e3 * RAIL_SIGMA, "wild_points_percent": 1.0},
    }


def _run(task: Task) -> Any:
    return task[0](*task[1:])


def _case_row(case: str, judged: list[refusals.Judged]) -> dict[str, object]:
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

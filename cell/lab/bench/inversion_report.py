"""Runs the inversion's campaigns on all cores and gathers what they show."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any

import numpy as np
from scipy.stats import chi2

from cell.inversion.closest import Array
from cell.lab.bench import inversion_refusals as refusals
from cell.lab.bench.inversion import Outcome, not_run, table, task
from cell.lab.bench.inversion_parts import PARTS
from cell.lab.bench.inversion_scenes import RAIL_SIGMA, STRIPE_SIGMA

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def campaign(starts: int, cases: int, peers: bool, progress: Callable[[int, int], None]) -> dict[str, object]:
    """Rows of `registration`, of `refusals` and the figures of `coverage`; `progress(done, total)` after each task."""
    before = {name: os.environ.get(name) for name in THREADS}
    # Read by the numeric libraries when the workers load them: each method gets one thread.
    os.environ.update(dict.fromkeys(THREADS, "1"))
    outcomes: list[Outcome] = []
    judged: list[refusals.Judged] = []
    scores: list[tuple[Array, float]] = []
    pool = ProcessPoolExecutor(len(os.sched_getaffinity(0)), get_context("spawn"))
    try:
        absent = pool.submit(not_run, peers)
        running: list[Future[Any]] = [pool.submit(task, part, seed, peers) for seed in range(starts) for part in PARTS]
        for case in refusals.CASES:
            running += [pool.submit(refusals.judge_case, case, seed) for seed in range(cases)]
        running += [pool.submit(refusals.coverage, seed) for seed in range(5 * cases)]
        for done, future in enumerate(as_completed(running), 1):
            result = future.result()
            if isinstance(result, list):
                outcomes += result
            elif isinstance(result, refusals.Judged):
                judged.append(result)
            elif isinstance(result, tuple):
                scores.append(result)
            progress(done, len(running))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    order = {part: k for k, part in enumerate(PARTS)}
    outcomes.sort(key=lambda outcome: (order[outcome.part], outcome.start, outcome.seed))
    return {
        "registration": table(outcomes),
        "not_run": absent.result(),
        "refusals": [_case_row(case, [j for j in judged if j.case == case]) for case in refusals.CASES],
        "coverage": _coverage(scores),
        "assumed_noise": {"stripe_mm": 1e3 * STRIPE_SIGMA, "rail_mm": 1e3 * RAIL_SIGMA, "wild_points_percent": 1.0},
    }


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

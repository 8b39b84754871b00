"""How many outliers are found and how few others, what a filled hole is worth, and how soon the cloud is there.

Beside the usual statistical outlier removal on the same points, which knows neither lines and rows nor the noise.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from cell.measure.reconstruction import fill_holes
from cell.measure.reconstruction.outliers import find_outliers
from lab.bench.reconstruction.scenes import KINDS, SURFACES, Mask, Scene, cut_holes, scene, sweep

SHARES = (0.01, 0.03, 0.05)
HOLES = ((1, 1), (2, 6), (4, 12), (1, 60))
CAMERAS = ((640, 480), (2048, 1088))
LINES = 300

Tell = Callable[[float, str], None]


def run(seed: int, tell: Tell) -> dict[str, Any]:
    """The whole campaign, JSON-ready; `tell` is given the share that is done and what is done next."""
    # Compile before anything is timed.
    find_outliers(*_depths(scene("steps", "near", 0.05, seed)))
    _holes(SURFACES[0], HOLES[0], seed)
    cases = [(surface, kind, share) for surface in SURFACES for kind in KINDS for share in SHARES]
    total = len(cases) + len(SURFACES) * len(HOLES) + len(CAMERAS)
    outliers, holes, speed = [], [], []
    for k, case in enumerate(cases):
        tell(k / total, f"outliers: {case[1]}, {100 * case[2]:.0f} %")
        outliers.append(_outliers(*case, seed))
    for k, (surface, size) in enumerate((s, h) for s in SURFACES for h in HOLES):
        tell((len(cases) + k) / total, f"holes of {size[0]}×{size[1]}")
        holes.append(_holes(surface, size, seed))
    for k, camera in enumerate(CAMERAS):
        tell((total - len(CAMERAS) + k) / total, f"speed at {camera[0]}×{camera[1]}")
        speed.append(_speed(*camera, seed))
    return {"outliers": outliers, "holes": holes, "speed": speed}


def _depths(made: Scene) -> tuple[np.ndarray, np.ndarray]:
    return made.depth, made.sigma


def _outliers(surface: str, kind: str, share: float, seed: int) -> dict[str, Any]:
    made = scene(surface, kind, share, seed)
    spent, found = _timed(lambda: find_outliers(made.depth, made.sigma))
    return {
        "surface": surface,
        "kind": kind,
        "share": share,
        **_judged(found, made.bad),
        "ms": 1e3 * spent,
    }


def _judged(found: Mask, bad: Mask) -> dict[str, float]:
    hits, placed, flagged = (int(mask.sum()) for mask in (found & bad, bad, found))
    return {"recall": hits / max(1, placed), "precision": hits / max(1, flagged)}


def _holes(surface: str, size: tuple[int, int], seed: int) -> dict[str, Any]:
    made = scene(surface, "far", 0.0, seed)
    cut = cut_holes(made.depth.shape, size, 200, seed)
    cloud = made.cloud(cut)
    spent, whole = _timed(lambda: fill_holes(cloud), 1)
    filled = whole.filled
    asked = cut[filled.lines, filled.rows]
    lines, rows = filled.lines[asked], filled.rows[asked]
    error = filled.points[asked, 2] - made.true[lines, rows]
    sigma = np.sqrt(filled.covariances[asked, 2, 2])
    return {
        "surface": surface,
        "lines": size[0],
        "rows": size[1],
        "filled": float(asked.sum() / np.count_nonzero(cut)),
        "error_rms_um": float(1e6 * np.sqrt(np.mean(error**2))),
        "z_rms": float(np.sqrt(np.mean((error / sigma) ** 2))),
        "ms": 1e3 * spent,
    }


def _speed(width: int, rows: int, seed: int) -> dict[str, Any]:
    builder, profiles = sweep(LINES, width, rows, seed)
    begun = time.perf_counter()
    for profile in profiles:
        builder.see(profile)
    seeing = (time.perf_counter() - begun) / LINES
    flanges = np.tile(np.eye(4), (LINES, 1, 1))
    rail = np.linspace(0.02, 0.08, LINES)
    spread = np.full((LINES, 3), 1e-5)
    after, cloud = _timed(lambda: builder.place(np.arange(LINES), flanges, rail, spread))
    begun = time.process_time()
    builder.place(np.arange(LINES), flanges, rail, spread)
    processor = time.process_time() - begun
    return {
        "width": width,
        "rows": rows,
        "lines": LINES,
        "points": cloud.size,
        "ms_per_profile": 1e3 * seeing,
        "ms_after_last_frame": 1e3 * after,
        "processor_ms_after_last_frame": 1e3 * processor,
    }


def _timed(work: Callable[[], Any], times: int = 3) -> tuple[float, Any]:
    """Seconds of the quickest of some runs, and the result."""
    best, made = np.inf, None
    for _ in range(times):
        begun = time.perf_counter()
        made = work()
        best = min(best, time.perf_counter() - begun)
    return float(best), made

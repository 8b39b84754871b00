"""How near the stripe's centres come to their bound, how true their stated σ is, and how fast they are extracted.

Once for Gaussians condition by condition, and once for the stripes of a workshop, which are held to limits.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.extract import StripeStream, extract
from lab.bench.stripe import truth, workshop
from lab.bench.stripe.truth import Cell
from lab.bench.stripe.workshop import Scene

SHAPE = (1024, 640)
WIDTHS = (1.2, 1.6, 2.0, 2.5, 3.0)
PEAKS = (40.0, 100.0, 220.0)
CONTRASTS = (0.0, 0.2, 0.5, 1.0)

LEAST_EFFICIENCY, STATED, LEAST_FOUND, MOST_FALSE = 0.9, (0.8, 1.2), 0.95, 0.01
FALSE_PX = 3.0
"""A centre this far off, and one width, is another thing than the stripe."""
PROFILES = ("Gaussian", "flat top", "halo", "one-sided")

SPEED_SHAPE, FRAMES = (1024, 1280), 32
CONDITION, SPECKLED = Cell(2.0, 150.0), Cell(2.0, 120.0, 0.2)

Progress = Callable[[float, str], None]
Image = NDArray[np.uint8]
Run = Callable[[list[Image]], Any]
Case = TypeVar("Case", Cell, Scene)


def conditions() -> list[Cell]:
    """Widths by peaks by contrasts, and steep backgrounds. With speckle, peaks that fit in 8 bits."""
    plain = [Cell(w, p, c) for c in CONTRASTS for w in WIDTHS for p in PEAKS if p <= 220 / (1 + 3 * c)]
    return plain + [Cell(w, 100.0, slope=0.15) for w in WIDTHS]


def measure(cell: Cell, pictures: int = 3, seed: int = 0) -> dict[str, Any]:
    """Of a condition: bound, RMS error, bias in px, efficiency (bound / RMS), stated σ / RMS, share found."""
    limit = truth.bound(cell, SHAPE)
    drawn = [truth.draw(cell, SHAPE, seed + k) for k in range(pictures)]
    profiles = [extract(image) for image, _ in drawn]
    error = np.concatenate([profile.centres - centres for profile, (_, centres) in zip(profiles, drawn, strict=True)])
    found = np.isfinite(error)
    error, sigma = error[found], np.concatenate([profile.sigma for profile in profiles])[found]
    rms = float(np.sqrt(np.mean(error**2)))
    return {
        "width_px": cell.width, "peak_dn": cell.peak, "contrast": cell.contrast, "slope_dn_per_px": cell.slope,
        "bound_px": limit, "rms_px": rms, "efficiency": limit / rms, "bias_px": float(np.mean(error)),
        "stated_over_true": float(np.sqrt(np.mean(sigma**2)) / rms), "found": float(np.mean(found)),
    }  # fmt: skip


def accuracy(progress: Progress, pictures: int = 3) -> dict[str, Any]:
    """All conditions. `progress` takes the share done and a text."""
    noise = {
        "electrons_per_dn": truth.ELECTRONS_PER_DN,
        "read_noise_dn": truth.READ_NOISE_DN,
        "rounding_dn": float(np.sqrt(1 / 12)),
    }
    rows = _each_of(conditions(), measure, progress, pictures)
    return {"assumed_noise": noise, "points_each": pictures * SHAPE[0], "rows": rows}


def scenes() -> list[Scene]:
    """Profiles by widths; texture; deep and coloured pictures. A one-sided stripe of .6 px has no flank on pixels."""
    widths = (0.6, 2.0, 5.0, 12.0, 30.0)
    plain = [Scene(p, w) for p in PROFILES for w in widths if not (p == "one-sided" and w < 1)]
    textured = [Scene("Gaussian", 2.0, texture=t, grain=g) for t, g in ((2.0, 2.0), (8.0, 2.0), (8.0, 1.0), (8.0, 4.0))]
    cameras = [Scene("Gaussian", 2.0, camera=c) for c in ("12 bit low", "12 bit high", "red", "green")]
    return plain + textured + cameras


def measure_scene(scene: Scene, pictures: int = 1, seed: int = 0) -> dict[str, Any]:
    """Errors of a scene's centres about their mean, for a profile without symmetry has its centre where one likes."""
    errors, stated = [], []
    found, false, marked = 0.0, 0.0, 0.0
    for k in range(pictures):
        image, centres = workshop.draw(scene, seed + k)
        seen = extract(image)
        error = seen.centres - centres
        there = np.isfinite(error)
        middle = float(np.median(error[there])) if there.any() else 0.0
        wrong = there & (np.abs(error - middle) > FALSE_PX + scene.width)
        found += float(np.mean(there & ~wrong)) / pictures
        false += float(wrong.sum() / max(1, there.sum())) / pictures
        marked += float(np.mean(seen.marks[there] > 0)) / pictures if there.any() else 0.0
        errors.append((error - middle)[there & ~wrong])
        stated.append(seen.sigma[there & ~wrong])
    error, sigma = np.concatenate(errors), np.concatenate(stated)
    rms = float(np.sqrt(np.mean(error**2))) if len(error) > 1 else float("nan")
    # The bound knows neither texture nor the print of coloured pictures.
    has_bound = not scene.texture and scene.camera not in ("red", "green")
    limit = workshop.bound(scene) if has_bound else None
    row: dict[str, Any] = {
        "scene": scene.name, "width_px": scene.width, "bound_px": limit, "rms_px": rms,
        "efficiency": None if limit is None else limit / rms,
        "stated_over_true": float(np.sqrt(np.mean(sigma**2)) / rms) if len(error) else float("nan"),
        "found": found, "false": false, "marked": marked,
    }  # fmt: skip
    row["within_limits"] = within_limits(row)
    return row


def within_limits(row: dict[str, Any]) -> bool:
    """True when a row of `measure_scene` keeps what is promised of it."""
    efficient = row["efficiency"] is None or row["efficiency"] >= LEAST_EFFICIENCY
    honest = STATED[0] <= row["stated_over_true"] <= STATED[1]
    return bool(efficient and honest and row["found"] >= LEAST_FOUND and row["false"] <= MOST_FALSE)


def profiles(progress: Progress, pictures: int = 3) -> dict[str, Any]:
    """All scenes. `progress` takes the share done and a text."""
    rows = _each_of(scenes(), measure_scene, progress, pictures)
    limits = {
        "least_efficiency": LEAST_EFFICIENCY, "stated_over_true": list(STATED), "least_found": LEAST_FOUND,
        "most_false": MOST_FALSE,
    }  # fmt: skip
    return {"limits": limits, "within_limits": all(row["within_limits"] for row in rows), "rows": rows}


def _each_of(
    cases: Sequence[Case], run: Callable[[Case, int, int], dict[str, Any]], progress: Progress, pictures: int
) -> list[dict[str, Any]]:
    """The rows of all cases, each with pictures of its own."""
    rows = []
    for k, case in enumerate(cases):
        progress(k / len(cases), str(case))
        rows.append(run(case, pictures, 100 * k))
    progress(1.0, "done")
    return rows


def speed(progress: Progress, repeats: int = 5) -> dict[str, Any]:
    """Milliseconds per frame and points per second of each way, best of `repeats` rounds.

    Each round runs through `FRAMES` different pictures, together larger than the processor's second-level cache. A
    point is one centre in one image row.
    """
    plain, speckled = (
        [truth.draw(cell, SPEED_SHAPE, seed)[0] for seed in range(FRAMES)] for cell in (CONDITION, SPECKLED)
    )
    candidates: list[tuple[str, Run, list[Image]]] = [
        ("reading each pixel once", lambda images: [np.max(image) for image in images], plain),
        ("a stream", _stream, plain),
        ("a stream with speckle contrast 0.2", _stream, speckled),
        ("single pictures", lambda images: [extract(image) for image in images], plain),
    ]
    rows: list[dict[str, Any]] = []
    cv2_threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        for k, (name, run, images) in enumerate(candidates):
            progress(k / len(candidates), name)
            seconds = _best(run, images, repeats)
            rows.append({"name": name, "ms_per_frame": 1e3 * seconds, "points_per_s": SPEED_SHAPE[0] / seconds})
    finally:
        cv2.setNumThreads(cv2_threads)
    for row in rows:
        row["times_reading"] = row["ms_per_frame"] / rows[0]["ms_per_frame"]
    progress(1.0, "speed done")
    return {"shape": list(SPEED_SHAPE), "frames": FRAMES, "rows": rows}


def _stream(images: list[Image]) -> None:
    stream = StripeStream()
    for image in images:
        stream.extract(image)


def _best(run: Run, images: list[Image], repeats: int) -> float:
    """Seconds a frame, best of some rounds after one picture to warm up."""
    run(images[:1])
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        run(images)
        best = min(best, (time.perf_counter() - begin) / len(images))
    return float(best)

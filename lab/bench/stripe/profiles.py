"""How near stripes of a workshop are read to their own bounds, and how true the stated σ is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cell.measure.vision.stripe.extract import extract
from lab.bench.stripe.workshop import Scene, bound, draw

LEAST_EFFICIENCY, STATED, LEAST_FOUND, MOST_FALSE = 0.9, (0.8, 1.2), 0.95, 0.01
FALSE_PX = 3.0
"""A centre this far off, and one width, is another thing than the stripe."""

WIDTHS = (0.6, 2.0, 5.0, 12.0, 30.0)
PROFILES = ("Gaussian", "flat top", "halo", "one-sided")


def scenes() -> list[Scene]:
    """Profiles by widths; texture; deep and coloured pictures. A one-sided stripe of .6 px has no flank on pixels."""
    plain = [Scene(p, w) for p in PROFILES for w in WIDTHS if not (p == "one-sided" and w < 1)]
    textured = [Scene("Gaussian", 2.0, texture=t, grain=g) for t, g in ((2.0, 2.0), (8.0, 2.0), (8.0, 1.0), (8.0, 4.0))]
    cameras = [Scene("Gaussian", 2.0, camera=c) for c in ("12 bit low", "12 bit high", "red", "green")]
    return plain + textured + cameras


def measure(scene: Scene, pictures: int = 1, seed: int = 0) -> dict[str, Any]:
    """Errors of a scene's centres about their mean, for a profile without symmetry has its centre where one likes."""
    errors, stated = [], []
    found, false, marked = 0.0, 0.0, 0.0
    for k in range(pictures):
        image, centres = draw(scene, seed + k)
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
    limit = bound(scene) if has_bound else None
    row: dict[str, Any] = {
        "scene": scene.name,
        "width_px": scene.width,
        "bound_px": limit,
        "rms_px": rms,
        "efficiency": None if limit is None else limit / rms,
        "stated_over_true": float(np.sqrt(np.mean(sigma**2)) / rms) if len(error) else float("nan"),
        "found": found,
        "false": false,
        "marked": marked,
    }
    row["within_limits"] = within_limits(row)
    return row


def within_limits(row: dict[str, Any]) -> bool:
    """True when a row of `measure` keeps what is promised of it."""
    efficient = row["efficiency"] is None or row["efficiency"] >= LEAST_EFFICIENCY
    honest = STATED[0] <= row["stated_over_true"] <= STATED[1]
    return bool(efficient and honest and row["found"] >= LEAST_FOUND and row["false"] <= MOST_FALSE)


def campaign(progress: Callable[[float, str], None], pictures: int = 3) -> dict[str, Any]:
    """All scenes. `progress` takes the share done and a text."""
    conditions: Sequence[Scene] = scenes()
    rows = []
    for k, scene in enumerate(conditions):
        progress(k / len(conditions), f"{scene.name}, width {scene.width} px")
        rows.append(measure(scene, pictures, seed=100 * k))
    progress(1.0, "profiles done")
    return {
        "limits": {
            "least_efficiency": LEAST_EFFICIENCY,
            "stated_over_true": list(STATED),
            "least_found": LEAST_FOUND,
            "most_false": MOST_FALSE,
        },
        "within_limits": all(row["within_limits"] for row in rows),
        "rows": rows,
    }

"""How near the stripe's centres come to the bound, condition by condition, and how true their σ is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cell.measure.vision.stripe.extract import extract
from lab.bench.stripe.truth import ELECTRONS_PER_DN, READ_NOISE_DN, Cell, bound, draw

SHAPE = (1024, 640)
WIDTHS = (1.2, 1.6, 2.0, 2.5, 3.0)
PEAKS = (40.0, 100.0, 220.0)
CONTRASTS = (0.0, 0.2, 0.5, 1.0)


def conditions() -> list[Cell]:
    """Widths by peaks by contrasts, and steep backgrounds. With speckle, peaks that fit in 8 bits."""
    plain = [Cell(w, p, c) for c in CONTRASTS for w in WIDTHS for p in PEAKS if p <= 220 / (1 + 3 * c)]
    return plain + [Cell(w, 100.0, slope=0.15) for w in WIDTHS]


def measure(cell: Cell, pictures: int = 3, seed: int = 0) -> dict[str, Any]:
    """Of a condition: bound, RMS error, bias in px, efficiency (bound / RMS), stated σ / RMS, share found."""
    limit = bound(cell, SHAPE)
    drawn = [draw(cell, SHAPE, seed + k) for k in range(pictures)]
    profiles = [extract(image) for image, _ in drawn]
    error = np.concatenate([profile.centres - centres for profile, (_, centres) in zip(profiles, drawn, strict=True)])
    found = np.isfinite(error)
    error, sigma = error[found], np.concatenate([profile.sigma for profile in profiles])[found]
    rms = float(np.sqrt(np.mean(error**2)))
    return {
        "width_px": cell.width,
        "peak_dn": cell.peak,
        "contrast": cell.contrast,
        "slope_dn_per_px": cell.slope,
        "bound_px": limit,
        "rms_px": rms,
        "efficiency": limit / rms,
        "bias_px": float(np.mean(error)),
        "stated_over_true": float(np.sqrt(np.mean(sigma**2)) / rms),
        "found": float(np.mean(found)),
    }


def campaign(progress: Callable[[float, str], None], pictures: int = 3) -> dict[str, Any]:
    """All conditions. `progress` takes the share done and a text."""
    cells = conditions()
    rows: list[dict[str, Any]] = []
    for k, cell in enumerate(cells):
        progress(k / len(cells), f"width {cell.width} px, peak {cell.peak:.0f} DN, speckle {cell.contrast}")
        rows.append(measure(cell, pictures, seed=100 * k))
    progress(1.0, "accuracy done")
    return {
        "assumed_noise": {
            "electrons_per_dn": ELECTRONS_PER_DN,
            "read_noise_dn": READ_NOISE_DN,
            "rounding_dn": float(np.sqrt(1 / 12)),
        },
        "points_each": pictures * SHAPE[0],
        "rows": rows,
    }

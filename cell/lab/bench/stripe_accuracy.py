"""How near every method of stripe extraction comes to the bound, condition by condition, and how true its σ is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cell.lab.bench.stripe_truth import ELECTRONS_PER_DN, READ_NOISE_DN, Cell, bound, draw
from cell.vision.stripe.extract import Method, extract

SHAPE = (1024, 640)
WIDTHS = (1.2, 1.6, 2.0, 2.5, 3.0)
PEAKS = (40.0, 100.0, 220.0)
CONTRASTS = (0.0, 0.2, 0.5, 1.0)


def conditions() -> list[Cell]:
    """Widths by peaks by contrasts, and steep backgrounds. With speckle, peaks that fit in 8 bits."""
    plain = [Cell(w, p, c) for c in CONTRASTS for w in WIDTHS for p in PEAKS if p <= 220 / (1 + 3 * c)]
    return plain + [Cell(w, 100.0, slope=0.15) for w in WIDTHS]


def measure(
    cell: Cell, methods: Sequence[Method] = tuple(Method), pictures: int = 3, seed: int = 0
) -> list[dict[str, Any]]:
    """One row for each method: bound, RMS error, bias in px, efficiency (bound / RMS), stated σ / RMS, share found."""
    limit = bound(cell, SHAPE)
    errors: dict[Method, list[Any]] = {m: [] for m in methods}
    stated: dict[Method, list[Any]] = {m: [] for m in methods}
    for k in range(pictures):
        image, centres = draw(cell, SHAPE, seed + k)
        for method in methods:
            profile = extract(image, method=method)
            errors[method].append(profile.centres - centres)
            stated[method].append(profile.sigma)
    rows = []
    for method in methods:
        error, sigma = np.concatenate(errors[method]), np.concatenate(stated[method])
        found = np.isfinite(error)
        error, sigma = error[found], sigma[found]
        rms = float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")
        rows.append(
            {
                "method": method.value,
                "width_px": cell.width,
                "peak_dn": cell.peak,
                "contrast": cell.contrast,
                "slope_dn_per_px": cell.slope,
                "bound_px": limit,
                "rms_px": rms,
                "efficiency": limit / rms,
                "bias_px": float(np.mean(error)) if len(error) else float("nan"),
                "stated_over_true": float(np.sqrt(np.mean(sigma**2)) / rms) if len(error) else float("nan"),
                "found": float(np.mean(found)),
            }
        )
    return rows


def campaign(progress: Callable[[float, str], None], pictures: int = 3) -> dict[str, Any]:
    """All conditions and methods. `progress` takes the share done and a text."""
    cells = conditions()
    rows: list[dict[str, Any]] = []
    for k, cell in enumerate(cells):
        progress(k / len(cells), f"width {cell.width} px, peak {cell.peak:.0f} DN, speckle {cell.contrast}")
        rows += measure(cell, pictures=pictures, seed=100 * k)
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


def draw_picture(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """RMS over bound against the stripe's width, without speckle and at the lowest contrast, as an image file."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, contrast in zip(axes, CONTRASTS[:2], strict=True):
        for method in Method:
            chosen = [
                r for r in rows
                if r["method"] == method.value and r["contrast"] == contrast and r["slope_dn_per_px"] == 0.02
            ]  # fmt: skip
            ratio = [
                np.median([r["rms_px"] / r["bound_px"] for r in chosen if r["width_px"] == width]) for width in WIDTHS
            ]
            axis.plot(WIDTHS, ratio, marker="o", label=method.value.replace("_", " "))
        axis.axhline(1.0, color="black", linewidth=0.8)
        axis.set(title=f"speckle contrast {contrast}", xlabel="stripe width σ in px", yscale="log")
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("RMS error / Cramér–Rao bound of one row")
    axes[1].legend(fontsize=8)
    figure.savefig(path, dpi=120)

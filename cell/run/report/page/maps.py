"""The drawings of a page that come from the cloud: the map with its histogram, and the points for the 3-D view."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cell.run.report.page.scanned import Scanned
from cell.run.report.pictures import frame_map, square_means
from drivers.interfaces import Vector

MOST_POINTS = 20_000
"""Points of the 3-D view; a cloud with more is thinned to so many, spread evenly over it."""
COLOURS, HEIGHTS = "RdBu_r", "viridis"
SHADES = 255
"""Of the scale in the 3-D view; the next number is a point without a value."""
BINS = 61
LEAST_IN_SQUARE = 5
"""Points in a square of the map that may be called an extreme: single ones are noise."""


def map_picture(scan: Scanned, span_mm: float) -> bytes:
    """A PNG: the points from above within ±`span_mm`, extremes labelled, and the histogram of the deviations."""
    figure = Figure(figsize=(11.0, 4.6), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.45, 1.0])
    frame_map(left, scan.points)
    if scan.deviation is None:
        _draw(figure, left, scan.points, scan.points[:, 2], "height in mm", cmap=HEIGHTS)
        left.set_xlabel("x about the cloud's middle, axes of the arm base, in mm")
        right.hist(scan.points[:, 2], BINS, color="0.4")
        right.set_xlabel("height in mm")
    else:
        on = np.isfinite(scan.deviation)
        points, values = scan.points[on], scan.deviation[on]
        _draw(
            figure,
            left,
            points,
            values,
            "deviation from the drawn surface in mm",
            cmap=COLOURS,
            vmin=-span_mm,
            vmax=span_mm,
            extend="both",
        )
        _label_extremes(left, points, values)
        right.hist(np.clip(values, -span_mm, span_mm), np.linspace(-span_mm, span_mm, BINS), color="0.4")
        right.set_xlim(-span_mm, span_mm)
        right.axvline(0.0, color="black", linewidth=0.8)
        right.set_xticks(np.linspace(-span_mm, span_mm, 5))
        right.set_xlabel("deviation in mm; the outer bars hold all beyond")
        right.set_title(_spread(values), fontsize="medium")
    right.set_ylabel("points")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw(
    figure: Figure, axes: Axes, points: Vector, values: Vector, label: str, extend: str = "neither", **look: Any
) -> None:
    if len(points):
        edges, mean = square_means(axes, points, values)
        shown = axes.pcolormesh(*edges, np.ma.masked_invalid(mean.T), **look)
        figure.colorbar(shown, ax=axes, label=label, extend=extend)


def _label_extremes(axes: Axes, points: Vector, values: Vector) -> None:
    edges, mean = square_means(axes, points, values)
    count, _, _ = np.histogram2d(points[:, 0], points[:, 1], edges)
    sure = np.where(count >= LEAST_IN_SQUARE, mean, np.nan)
    if not np.isfinite(sure).any():
        return
    for pick, marker in ((np.nanargmax, "^"), (np.nanargmin, "v")):
        i, j = np.unravel_index(pick(sure), sure.shape)
        x, y = (0.5 * (edge[k] + edge[k + 1]) for edge, k in zip(edges, (i, j), strict=True))
        axes.plot(x, y, marker, color="black", markerfacecolor="none", markersize=9)
        side = "left" if x < np.mean(axes.get_xlim()) else "right"
        axes.annotate(
            f"{sure[i, j]:+.3f}",
            (x, y),
            xytext=(9 if side == "left" else -9, 0),
            textcoords="offset points",
            ha=side,
            va="center",
            fontsize=9,
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )
    axes.set_title("▲ ▼ largest and smallest mean of a square", fontsize="medium")


def _spread(values: Vector) -> str:
    if not len(values):
        return "no point lies over the surface"
    rms, p95 = np.sqrt(np.mean(values**2)), np.percentile(np.abs(values), 95)
    return f"{len(values)} points: mean {values.mean():+.4f} mm,\nRMS {rms:.4f} mm, 95 % within {p95:.4f} mm"


def view_data(scan: Scanned, span_mm: float) -> Mapping[str, Any]:
    """The points of the 3-D view for `cloud.js`, JSON-ready.

    `points` is base64 of little-endian int16 (x, y, z of each), in `step` mm about the cloud's middle; `shades` of one
    byte each, an index into `palette`, whose last colour is that of points without a value. `from` and `to` end the
    scale, `apart` is about how far points lie from each other, in mm.
    """
    total = len(scan.points)
    chosen = np.linspace(0, total - 1, min(total, MOST_POINTS)).astype(np.intp)
    if total > MOST_POINTS:
        # One at random of each stretch: a regular stride falls into step with the rows.
        edges = np.linspace(0, total, MOST_POINTS + 1)
        chosen = (edges[:-1] + np.random.default_rng(0).random(MOST_POINTS) * np.diff(edges)).astype(np.intp)
    points = scan.points[chosen]
    low, high = points.min(axis=0), points.max(axis=0)
    middle, step = 0.5 * (low + high), max(float((high - low).max()), 1e-3) / 60_000
    values, ends = (scan.points[:, 2], None) if scan.deviation is None else (scan.deviation, span_mm)
    begin, end = (-ends, ends) if ends is not None else (float(low[2]), float(max(high[2], low[2] + 1e-3)))
    share = np.clip((values[chosen] - begin) / (end - begin), 0.0, 1.0)
    shades = np.where(np.isfinite(share), np.nan_to_num(share) * (SHADES - 1), SHADES).astype(np.uint8)
    palette = matplotlib.colormaps[HEIGHTS if ends is None else COLOURS](np.linspace(0, 1, SHADES))[:, :3]
    return {
        "points": _base64(np.round((points - middle) / step).astype("<i2")),
        "shades": _base64(shades),
        "palette": _base64(np.vstack([np.round(255 * palette), [115, 115, 115]]).astype(np.uint8)),
        "step": step,
        "apart": float(np.sqrt(np.prod(np.maximum((high - low)[:2], 0.1)) / max(1, len(points)))),
        "count": len(points),
        "total": total,
        "from": begin,
        "to": end,
    }


def _base64(values: Any) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")

"""The scanned surface on a run's page: points in mm, how far they lie off the drawn surface, and drawings of both."""

from __future__ import annotations

import base64
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_ur, transform
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.part_pose import seen_from_above
from cell.measure.reconstruction.ply import read_cloud
from cell.run.folder import Report
from cell.run.report.evidence import CLOUD
from cell.run.report.figures import texture_words
from cell.run.report.pictures import SCALE_SHARE, frame_map, square_means
from drivers.errors import CellError
from drivers.interfaces import Vector

SPAN_MM = 0.2
"""End of the scale of deviations where a report names no tolerance."""
MOST_POINTS = 20_000
"""Points of the 3-D view; a cloud with more is thinned to so many, spread evenly over it."""
COLOURS, HEIGHTS = "RdBu_r", "viridis"
SHADES = 255
"""Of the scale in the 3-D view; the next number is a point without a value."""
BINS = 61
LEAST_IN_SQUARE = 5
"""Points in a square of the map that may be called an extreme: single ones are noise."""


class Scanned(NamedTuple):
    """Measured points (n, 3) in mm and their deviations (n,) in mm, NaN beside the surface.

    With deviations the points are in the surface's frame; without (None) they are about their middle, axes of the arm
    base, and `why` says what the deviations lack.
    """

    points: Vector
    deviation: Vector | None
    why: str


class SurfaceView(NamedTuple):
    """What a page shows of a cloud: the `map` as PNG, and `cloud`, the points of the 3-D view for `cloud.js`.

    `compared` tells whether it is coloured by deviations, ± `span_mm`; else it is by height, and `why` says why.
    `stops` are the scale's colours for CSS. `waviness` are words for what is told of it, "" without.
    """

    map: bytes
    cloud: Mapping[str, Any]
    compared: bool
    why: str
    span_mm: float
    stops: Sequence[str]
    waviness: str


def surface_view(folder: Path, report: Report) -> SurfaceView | None:
    """What is shown of the run's cloud, None where it has none; `CellError` for one that cannot be read."""
    scan = scanned(folder, report)
    if scan is None or not len(scan.points):
        return None
    tolerance = (report.get("tolerance") or {}).get("translation_mm")
    span = SPAN_MM if tolerance is None else SCALE_SHARE * float(tolerance)
    compared = scan.deviation is not None
    stops = [f"rgb({r},{g},{b})" for r, g, b in _palette(compared)[:SHADES:15]]
    return SurfaceView(
        map=map_picture(scan, span), cloud=view_data(scan, span), compared=compared, why=scan.why, span_mm=span,
        stops=stops, waviness=texture_words(report),
    )  # fmt: skip


def scanned(folder: Path, report: Report) -> Scanned | None:
    """The cloud of a run, None where it has none; `CellError` for one that cannot be read."""
    if not (folder / CLOUD).exists():
        return None
    cloud = read_cloud(folder / CLOUD)
    points = cloud.points[~cloud.interpolated]
    try:
        base_from_surface, nominal = _surface(folder, report)
    except _NotKnown as error:
        middle = points.mean(axis=0) if len(points) else np.zeros(3)
        return Scanned(1e3 * (points - middle), None, str(error))
    local = transform(base_from_surface.inverse(), points)
    return Scanned(1e3 * local, 1e3 * nominal.deviations(local), "")


class _NotKnown(Exception):
    """Why a cloud cannot be compared with the drawn surface."""


def _surface(folder: Path, report: Report) -> tuple[pin.SE3, NominalSurface]:
    """The surface's pose that the run found, and the surface itself if its file is the one that the run had."""
    if (place := report.get("place_pose")) is None:
        raise _NotKnown("the run did not find the surface's place")
    try:
        job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
        part, unit = job["place"]["surface_from_part"], job["surface"]["mesh_unit"]
        surface_from_part = pin.SE3(pin.rpy.rpyToMatrix(*part["rotation"]), np.array(part["translation"]))
        file, told = Path(report["mesh"]["file"]), report["mesh"]["sha256"]
        if hashlib.sha256(file.read_bytes()).hexdigest() != told:
            raise _NotKnown(f"{file.name} was changed since the run: it is not the surface that was scanned for")
        nominal = NominalSurface.load(file, unit=unit)
        if job.get("nest") is not None and job["job"]["kind"] != "load":
            nominal = seen_from_above(nominal, surface_from_part)
    except (OSError, ValueError, KeyError, TypeError, CellError) as error:
        raise _NotKnown(f"the drawn surface cannot be read any more: {error}") from error
    values = np.array([*(1e-3 * v for v in place["translation_mm"]), *place["rotation_vector_rad"]])
    return from_ur(values) * surface_from_part.inverse(), nominal


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
            figure, left, points, values, "deviation from the drawn surface in mm", cmap=COLOURS, vmin=-span_mm,
            vmax=span_mm, extend="both",
        )  # fmt: skip
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
        box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
        axes.annotate(
            f"{sure[i, j]:+.3f}", (x, y), fontsize=9, bbox=box, textcoords="offset points", ha=side, va="center",
            xytext=(9 if side == "left" else -9, 0),
        )  # fmt: skip
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
    compared = scan.deviation is not None
    values = scan.points[:, 2] if scan.deviation is None else scan.deviation
    begin, end = (-span_mm, span_mm) if compared else (float(low[2]), float(max(high[2], low[2] + 1e-3)))
    share = np.clip((values[chosen] - begin) / (end - begin), 0.0, 1.0)
    shades = np.where(np.isfinite(share), np.nan_to_num(share) * (SHADES - 1), SHADES).astype(np.uint8)
    return {
        "points": _base64(np.round((points - middle) / step).astype("<i2")), "shades": _base64(shades),
        "palette": _base64(_palette(compared)), "step": step,
        "apart": float(np.sqrt(np.prod(np.maximum((high - low)[:2], 0.1)) / max(1, len(points)))), "count": len(points),
        "total": total, "from": begin, "to": end,
    }  # fmt: skip


def _palette(compared: bool) -> NDArray[np.uint8]:
    """Colours (256, 3) of the scale, and after them that of a point without a value."""
    colours = matplotlib.colormaps[COLOURS if compared else HEIGHTS](np.linspace(0, 1, SHADES))[:, :3]
    return np.vstack([np.round(255 * colours), [115, 115, 115]]).astype(np.uint8)


def _base64(values: Any) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")

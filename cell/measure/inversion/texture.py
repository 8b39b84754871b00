"""Waviness of the scanned surface: Sa, Sq and Sz of what is left of its heights over the nominal one.

The S-F surface of ISO 25178-2, made as ISO 25178-3 says: an areal Gaussian S-filter (ISO 16610-61), then an F-operator,
and no L-filter. The F-operator takes out the pose of the nominal surface and a surface of second order. Lines of even
and of odd number are filtered by themselves as well: what only one of both shows is the sensor's noise
(docs/explanation/theory.md, section 9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import transform
from cell.measure.inversion.nominal import SIGMA_FLOOR, Array, NominalSurface
from cell.measure.inversion.registration import across
from cell.measure.reconstruction.cloud import Cloud, Indices, Mask, Motions
from drivers.errors import Measured

ALPHA = float(np.sqrt(np.log(2.0) / np.pi))
"""Of the Gaussian filter: it lets half of a wave of the cutoff's length through (ISO 16610-61)."""
SERIES = tuple(1e-3 * v for v in (0.1, 0.2, 0.25, 0.5, 0.8, 1.0, 2.0, 2.5, 5.0, 8.0, 10.0, 20.0, 25.0, 50.0))
"""Nesting indices to choose from, m, as in ISO 25178-3."""
LEAST_SAMPLES = 3
"""Samples across a nesting index: what ISO 25178-3 asks of optical sensors."""
CELLS, MOST_CELLS = 8, 1000
"""Cells of the grid across a nesting index, and along a side of the area."""
LEAST_WEIGHT = 0.4
"""Of the filter's weight inside the area, from which on a cell counts: half is at a straight edge."""
LEAST_POINTS, LEAST_WIDTH = 500, 5
"""Points and nesting indices across the area for figures that say something."""
REACH, STEEPEST = 0.002, 0.5
"""No heights are points farther from the nominal surface, m, or where its normal has less along the mean normal."""
SURE = 2.0
"""Standard deviations of what calibration and poses leave open that a figure has to exceed."""
MOST_MOVED = 5000
"""Points on which those are looked at."""


@dataclass(frozen=True, eq=False)
class Heights:
    """Points over the nominal surface: `places` (n, 2) across it and `heights` (n,) along its mean normal, m.

    `slopes` (n, 2): of the nominal surface below them. `lines` (n,): numbers of their lines. `steps`: the usual
    distance from line to line, and along a line, m. `unsure` (k, m): by how much each of m independent errors, one
    standard deviation, raises the points of numbers `some` (k,), m. `shaken`: RMS, m, of what the lines go up and down
    by with a vehicle that seems to rock.
    """

    places: Array
    heights: Array
    slopes: Array
    lines: Indices
    steps: tuple[float, float]
    some: Indices
    unsure: Array
    shaken: float = 0.0


@dataclass(frozen=True)
class Texture:
    """Areal parameters in m, None with a `reason` where they cannot be told.

    `sa`, `sq`, `sz`: arithmetic mean and root mean square height, and the greatest less the least, noise taken out.
    `limit`: an Sq below it cannot be told from the sensor. `noise`: Sq of the noise that was taken out. `nesting`: the
    S-filter's index, m. `area` in m² and `points` that the figures are of.
    """

    sa: float | None
    sq: float | None
    sz: float | None
    limit: float | None
    noise: float | None
    nesting: float
    area: float
    points: int
    reason: str = ""

    def as_dict(self) -> dict[str, object]:
        """For the report, in mm and mm²."""
        lengths = ("sa", "sq", "sz", "limit", "noise", "nesting")
        shown = {f"{name}_mm": _mm(getattr(self, name)) for name in lengths}
        return {**shown, "area_mm2": round(1e6 * self.area, 1), "points": self.points, "reason": self.reason}

    def measured(self) -> tuple[Measured, ...]:
        """Sq, or what it is less than, for what a run has measured; nothing where the area says nothing."""
        if self.limit is None:
            return ()
        if self.sq is None:
            return (Measured("waviness of the surface, Sq, is less than", 1e3 * self.limit, "mm"),)
        return (Measured("waviness of the surface, Sq", 1e3 * self.sq, "mm"),)


def _mm(value: float | None) -> float | None:
    return None if value is None else round(1e3 * value, 5)


def measure_texture(given: Heights) -> Texture:
    """The figures of the whole area that the points cover. Holes narrower than the nesting index are bridged."""
    many = len(given.heights)
    span = np.ptp(given.places, axis=0) if many else np.zeros(2)
    index = nesting_index(given.steps, float(span.max()))
    if many < LEAST_POINTS:
        reason = f"{many} points lie over the surface, at least {LEAST_POINTS} are needed"
        return Texture(None, None, None, None, None, index, 0.0, many, reason)
    every = np.ones(many, dtype=np.bool_)
    fields = [_filtered(given, values, every, index) for values in (given.heights, *given.slopes.T)]
    inside = np.isfinite(fields[0])
    cell = index / CELLS
    area = float(inside.sum()) * cell**2
    # Of any outline: as wide as its area lets it be over its longer side.
    width = area / max(float(span.max()), cell)
    if width < LEAST_WIDTH * index:
        reason = (
            f"the area is {1e3 * width:.1f} mm wide, at least {1e3 * LEAST_WIDTH * index:.1f} mm are needed with "
            f"lines {1e3 * given.steps[0]:.2f} mm apart; scan a wider area, or more slowly"
        )
        return Texture(None, None, None, None, None, index, area, many, reason)
    heights, *slopes = (field[inside] for field in fields)
    surface = form_removed(np.argwhere(inside) * cell, np.asarray(np.transpose(slopes)), heights)
    noise, some = _noise(given, index), given.some
    seen = float(np.sqrt(np.mean(surface**2)))
    unknown = form_removed(given.places[some], given.slopes[some], given.unsure)
    spread = float(np.sum(np.mean(unknown**2, axis=0)))
    limit = float(np.sqrt(noise**2 + SURE**2 * spread + given.shaken**2 + SIGMA_FLOOR**2))
    sq = float(np.sqrt(max(0.0, seen**2 - noise**2)))
    if sq <= limit:
        cause = "a vehicle that rocks" if given.shaken else "the sensor"
        reason = f"an Sq below {1e3 * limit:.4f} mm cannot be told from {cause}"
        return Texture(None, None, None, limit, noise, index, area, many, reason)
    # What noise adds to Sa and Sz is taken out in the share that it has in Sq.
    share = sq / seen
    mean, total = share * float(np.mean(np.abs(surface))), share * float(np.ptp(surface))
    return Texture(mean, sq, total, limit, noise, index, area, many)


def nesting_index(steps: tuple[float, float], longest: float) -> float:
    """The least of the series, m, that has samples enough, and a grid that is not too large."""
    least = max(LEAST_SAMPLES * max(steps), CELLS * longest / MOST_CELLS)
    return next((index for index in SERIES if index >= least), SERIES[-1])


def _noise(given: Heights, index: float) -> float:
    """Sq, m, of the noise of all lines filtered with `index`.

    Half of the lines, filtered twice as long, have half of the points in four times the area: half the variance.
    """
    even, odd = (_filtered(given, given.heights, given.lines % 2 == half, 2.0 * index) for half in (0, 1))
    return float(np.sqrt(np.nanmean((even - odd) ** 2)))


def _filtered(given: Heights, values: Array, which: Mask, index: float) -> Array:
    """Those of the points' `values` (n,) on a grid of the whole area, filtered; NaN where there are too few around."""
    cell = index / CELLS
    low = given.places.min(axis=0)
    i, j = np.floor((given.places - low) / cell).astype(np.intp).T
    shape = (int(i.max()) + 1, int(j.max()) + 1)
    flat = (i * shape[1] + j)[which]
    count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(flat, values[which], minlength=shape[0] * shape[1]).reshape(shape)
    # What a cell's width smooths is not smoothed again.
    narrower = float(np.sqrt(index**2 - np.pi * cell**2 / (6.0 * ALPHA**2)))
    present = (count > 0).astype(np.float64)
    return gaussian(total / np.maximum(count, 1), present, narrower / cell)


def gaussian(heights: Array, weights: Array, cutoff: float) -> Array:
    """The areal Gaussian filter (ISO 16610-61) with its `cutoff` in cells, of `heights` (n, m) with `weights` (n, m).

    A normalised convolution: weights of 0 are holes, as is all beyond the edge. NaN where less than `LEAST_WEIGHT` of
    what is usual lies around a cell.
    """
    along, beside = (
        np.exp(-np.pi * (np.subtract.outer(np.arange(n), np.arange(n)) / (ALPHA * cutoff)) ** 2) for n in heights.shape
    )
    total = along @ (weights * heights) @ beside
    around = along @ weights @ beside
    usual = float(np.median(around[weights > 0.0])) if weights.any() else 1.0
    return np.where(around >= LEAST_WEIGHT * usual, total / np.maximum(around, 1e-300), np.nan)


def form_removed(at: Array, slopes: Array, heights: Array) -> Array:
    """`heights` (n,) or (n, m) at places (n, 2) less what a surface of second order and a motion of the nominal
    surface, with its `slopes` (n, 2), explain in least squares."""
    x, y = ((at - at.mean(axis=0)) / np.ptp(at, axis=0).max()).T
    by_x, by_y = slopes.T
    basis = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y, by_x, by_y, x * by_y - y * by_x])
    return np.asarray(heights - basis @ np.linalg.lstsq(basis, heights, rcond=1e-6)[0])


def heights_over(
    cloud: Cloud, nominal: NominalSurface, base_from_surface: pin.SE3, motions: tuple[Motions, ...], shaken: float
) -> Heights:
    """What of a cloud lies over the nominal surface at the pose found.

    `motions` say how the points move by what is not known of calibration and poses; `shaken` as in `Heights`.
    """
    normal, sides = across(nominal)
    lines, rows = cloud.valid.nonzero()
    local = transform(base_from_surface.inverse(), cloud.points[lines, rows])
    chosen, feet = nominal.feet(local, REACH)
    upright = feet.normals @ normal
    keep = feet.inner & (upright > STEEPEST)
    chosen, upright, normals = chosen[keep], upright[keep], feet.normals[keep]
    places, lines, rows = local[chosen] @ sides.T, lines[chosen], rows[chosen]
    some = np.unique(np.linspace(0, max(0, len(lines) - 1), min(MOST_MOVED, len(lines))).astype(np.intp))
    moved = np.concatenate([each(lines[some], rows[some]) for each in motions], axis=2)
    raised = np.einsum("ni,nim->nm", normals[some] @ base_from_surface.rotation.T, moved)
    ways = (cloud.points[1:] - cloud.points[:-1], cloud.points[:, 1:] - cloud.points[:, :-1])
    lengths = [np.linalg.norm(way, axis=2) for way in ways]
    steps = [float(np.median(each[np.isfinite(each)])) if np.isfinite(each).any() else 0.0 for each in lengths]
    return Heights(
        places, feet.heights[keep] / upright, -normals @ sides.T / upright[:, None], lines,
        steps=(steps[0], steps[1]), some=some, unsure=raised / upright[some, None], shaken=shaken,
    )  # fmt: skip

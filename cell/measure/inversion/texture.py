"""Waviness of the scanned surface: Sa, Sq and Sz of what is left of its heights over the nominal one.

The S-F surface after ISO 25178-2, its two operations exchanged: an F-operator, an areal Gaussian S-filter (ISO
16610-61, weights normalised at edges and holes), and no L-filter. The F-operator takes out the pose of the nominal
surface and a surface of second order; it comes first, so that no slope meets the edge of the area. Lines of even and of
odd number are filtered by themselves as well: what only one of both shows is the sensor's noise
(docs/explanation/theory.md, section 9).
"""

from dataclasses import dataclass, replace

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
LEAST_SAMPLES, CELLS, MOST_CELLS = 3, 8, 1000
"""Samples across a nesting index, as ISO 25178-3 asks of optical sensors; cells across it, and along the whole area."""
EDGE_WEIGHT, INNER_WEIGHT = 0.4, 0.9
"""Of the filter's usual weight, from which on a cell counts, and counts for the noise: half is at a straight edge."""
LEAST_POINTS, LEAST_WIDTH = 500, 5
"""Points and nesting indices across the area for figures that say something."""
REACH, STEEPEST = 0.002, 0.5
"""No heights are points farther from the nominal surface, m, or where its normal has less along the mean normal."""
SURE, MOST_MOVED = 2.0, 5000
"""Standard deviations of what is not known of calibration and poses that a figure exceeds; points to look at for it."""


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

    `nesting`: the S-filter's index, m; `area` in m² and `points` that the figures are of. `sa`, `sq`, `sz`: arithmetic
    mean and root mean square height, and the greatest less the least, noise taken out. `limit`: an Sq below it cannot
    be told from the sensor. `noise`: Sq of the noise that was taken out.
    """

    nesting: float
    points: int
    area: float = 0.0
    reason: str = ""
    sa: float | None = None
    sq: float | None = None
    sz: float | None = None
    limit: float | None = None
    noise: float | None = None

    def as_dict(self) -> dict[str, object]:
        """For the report, in mm and mm²."""
        values = {name: getattr(self, name) for name in ("sa", "sq", "sz", "limit", "noise", "nesting")}
        shown = {f"{name}_mm": None if v is None else round(1e3 * v, 5) for name, v in values.items()}
        return {**shown, "area_mm2": round(1e6 * self.area, 1), "points": self.points, "reason": self.reason}

    def measured(self, area: str = "the surface") -> tuple[Measured, ...]:
        """Sq, or what it is less than, for what a run has measured; nothing where the area says nothing."""
        if self.limit is None:
            return ()
        name, value = ("Sq", self.sq) if self.sq is not None else ("Sq, is less than", self.limit)
        return (Measured(f"waviness of {area}, {name}", 1e3 * value, "mm"),)


def measure_texture(given: Heights) -> Texture:
    """The figures of the whole area that the points cover. Holes narrower than the nesting index are bridged."""
    many, some = len(given.heights), given.some
    span = float(np.ptp(given.places, axis=0).max()) if many else 0.0
    # Three samples or more, and a grid that is not too large.
    least = max(LEAST_SAMPLES * max(given.steps), CELLS * span / MOST_CELLS)
    index = next((index for index in SERIES if index >= least), SERIES[-1])
    if many < LEAST_POINTS:
        return Texture(index, many, reason=f"{many} points lie over the surface, at least {LEAST_POINTS} are needed")
    left = form_removed(given.places, given.slopes, given.heights)
    filtered = _filtered(given.places, left, index)
    surface = filtered[np.isfinite(filtered)]
    surface = surface - surface.mean()
    made = Texture(index, many, area=len(surface) * (index / CELLS) ** 2)
    # Half of the lines, filtered twice as long, have half of the points in four times the area: half the variance.
    even, odd = (_filtered(given.places, left, 2.0 * index, given.lines % 2 == half) for half in (0, 1))
    apart = (even - odd)[np.isfinite(even - odd)]
    # Of any outline: as wide as its area lets it be over its longer side.
    width = made.area / max(span, index / CELLS)
    if width < LEAST_WIDTH * index or not len(apart):
        needed = (
            f"at least {1e3 * LEAST_WIDTH * index:.1f} mm are needed with lines {1e3 * given.steps[0]:.2f} mm apart"
        )
        reason = f"the area is {1e3 * width:.1f} mm wide, {needed}; scan a wider area, or more slowly"
        return replace(made, reason=reason)
    noise, seen = (float(np.sqrt(np.mean(each**2))) for each in (apart, surface))
    unknown = form_removed(given.places[some], given.slopes[some], given.unsure)
    spread = float(np.sum(np.mean(unknown**2, axis=0)))
    # Of a small area the noise itself is known roughly: as the mean square of so many independent numbers.
    squares = len(apart) * (index / CELLS * 2.0) ** 2 / (2.0 * ALPHA * index) ** 2
    parts = {
        "the sensor's noise": noise**2 * (1.0 + 3.0 * float(np.sqrt(2.0 / squares))),
        "what is not known of calibration and poses": SURE**2 * spread, "a vehicle that rocks": given.shaken**2,
    }  # fmt: skip
    limit = float(np.sqrt(sum(parts.values()) + SIGMA_FLOOR**2))
    sq = float(np.sqrt(max(0.0, seen**2 - noise**2)))
    made = replace(made, limit=limit, noise=noise)
    if sq <= limit:
        cause = max(parts, key=lambda name: parts[name])
        return replace(made, reason=f"an Sq below {1e3 * limit:.4f} mm cannot be told from {cause}")
    # What noise adds to Sa and Sz is taken out in the share that it has in Sq.
    sa, sz = (sq / seen * float(value) for value in (np.mean(np.abs(surface)), np.ptp(surface)))
    return replace(made, sa=sa, sq=sq, sz=sz)


def _filtered(places: Array, heights: Array, index: float, which: Mask | None = None) -> Array:
    """Heights (n,) on a grid over all places (n, 2), those of `which` (n,) filtered; NaN where too few are around."""
    cell = index / CELLS
    i, j = np.round((places - places.min(axis=0)) / cell).astype(np.intp).T
    shape = (int(i.max()) + 1, int(j.max()) + 1)
    weights = np.ones(len(heights)) if which is None else which.astype(np.float64)
    flat, cells = i * shape[1] + j, shape[0] * shape[1]
    count = np.bincount(flat, weights, minlength=cells).reshape(shape)
    total = np.bincount(flat, weights * heights, minlength=cells).reshape(shape)
    # What a cell's width smooths is not smoothed again.
    narrower = float(np.sqrt(index**2 - np.pi * cell**2 / (6.0 * ALPHA**2)))
    # Where the area ends the halves see different ends of it, which is no noise.
    least = EDGE_WEIGHT if which is None else INNER_WEIGHT
    return gaussian(total / np.maximum(count, 1.0), (count > 0).astype(np.float64), narrower / cell, least)


def gaussian(heights: Array, weights: Array, cutoff: float, least: float) -> Array:
    """The areal Gaussian filter (ISO 16610-61) with its `cutoff` in cells, of `heights` (n, m) with `weights` (n, m).

    A normalised convolution: weights of 0 are holes, as is all beyond the edge. NaN where less than the share `least`
    of what is usual lies around a cell.
    """
    apart = (np.subtract.outer(np.arange(n), np.arange(n)) / (ALPHA * cutoff) for n in heights.shape)
    # Numbers too small to be normal are slow.
    along, beside = (np.where(np.abs(each) < 3.2, np.exp(-np.pi * each**2), 0.0) for each in apart)
    total, around = along @ (weights * heights) @ beside, along @ weights @ beside
    usual = float(np.median(around[weights > 0.0])) if weights.any() else 1.0
    return np.where(around >= least * usual, total / np.maximum(around, 1e-300), np.nan)


def form_removed(at: Array, slopes: Array, heights: Array) -> Array:
    """`heights` (n,) or (n, m) at places (n, 2) less what a surface of second order and a motion of the nominal
    surface, with its `slopes` (n, 2), explain in least squares."""
    x, y = ((at - at.mean(axis=0)) / np.ptp(at, axis=0).max()).T
    by_x, by_y = slopes.T
    basis = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y, by_x, by_y, x * by_y - y * by_x])
    return np.asarray(heights - basis @ np.linalg.lstsq(basis, heights, rcond=1e-6)[0])


def heights_over(
    cloud: Cloud, nominal: NominalSurface, base_from_surface: pin.SE3, motions: tuple[Motions, ...], shaken: float,
    within: Array | None = None,
) -> Heights:  # fmt: skip
    """What of a cloud lies over the nominal surface at the pose found.

    `motions` say how the points move by what is not known of calibration and poses; `shaken` as in `Heights`; `within`
    are the lowest and the highest x and y (2, 2) of an area in the surface's frame, m.
    """
    normal, sides = across(nominal)
    lines, rows = cloud.valid.nonzero()
    local = transform(base_from_surface.inverse(), cloud.points[lines, rows])
    chosen, feet = nominal.feet(local, REACH)
    keep = feet.inner & (feet.normals @ normal > STEEPEST)
    if within is not None:
        keep &= ((local[chosen, :2] >= within[0]) & (local[chosen, :2] <= within[1])).all(axis=1)
    chosen, normals = chosen[keep], feet.normals[keep]
    upright, places, lines, rows = normals @ normal, local[chosen] @ sides.T, lines[chosen], rows[chosen]
    some = np.unique(np.linspace(0, max(0, len(lines) - 1), min(MOST_MOVED, len(lines))).astype(np.intp))
    moved = np.concatenate([each(lines[some], rows[some]) for each in motions], axis=2)
    raised = np.einsum("ni,nim->nm", (normals / upright[:, None])[some] @ base_from_surface.rotation.T, moved)
    ways = (np.diff(cloud.points, axis=0), np.diff(cloud.points, axis=1))
    down, along = (float(np.nanmedian(np.linalg.norm(way, axis=2))) for way in ways)
    return Heights(
        places, feet.heights[keep] / upright, -normals @ sides.T / upright[:, None], lines, steps=(down, along),
        some=some, unsure=raised, shaken=shaken,
    )  # fmt: skip

"""The stripe's own profile across the line: a Gaussian until the picture shows otherwise, then what the picture shows.

Registered lines give many samples of one profile at all sub-pixel places. What they differ from a Gaussian by is
fitted by a penalised cubic spline. It is kept where it foretells held-out lines better (docs/explanation/theory.md,
section 5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from cell.base.compiled import compiled

Array = NDArray[np.float64]

FINE = 16
"""Places of the table in one knot interval."""
KNOTS_PER_WIDTH = 8.0
# Precision of the differences of neighbouring spline coefficients, in samples: enough to bridge what no line shows.
SMOOTHING, RIDGE = 0.01, 1e-3


@dataclass(frozen=True)
class Shape:
    """A profile of height 1 as a table: `value` and `slope` (per px) at `first` + k · `step` px from the centre.

    `width` is the σ in px of the Gaussian that fits it best, and whose centre is the profile's. `learned` is False of a
    Gaussian.
    """

    first: float
    step: float
    value: Array
    slope: Array
    width: float
    learned: bool

    @property
    def reach(self) -> float:
        """How far from its centre, in px, the profile is known; it is 0 beyond."""
        return -self.first

    def at(self, x: Array) -> tuple[Array, Array]:
        """Value and slope of the profile at `x` px from its centre, any shape."""
        place = np.clip((x - self.first) / self.step, 0.0, len(self.value) - 1.000001)
        k = place.astype(np.intp)
        part = place - k
        value = self.value[k] + part * (self.value[k + 1] - self.value[k])
        slope = self.slope[k] + part * (self.slope[k + 1] - self.slope[k])
        return value, slope


def gaussian(width: float, reach: float | None = None) -> Shape:
    """The Gaussian of σ `width` px, as the mean over a pixel has it, to `reach` px, or 5 widths and a bit."""
    reach = reach or 5.0 * width + 2.0
    step = width / KNOTS_PER_WIDTH / FINE
    count = int(np.ceil(reach / step))
    z = np.arange(-count, count + 1) * (step / width)
    value = np.exp(-0.5 * z * z)
    return Shape(-count * step, step, value, slope=-value * z / width, width=width, learned=False)


def learn(x: Array, value: Array, weight: Array, width: float, reach: float) -> Shape:
    """The profile that samples `value` (m,) of height about 1 at `x` (m,) px from the centre show, with `weight` (m,).

    `width` is that of the Gaussian from which it is taken to differ, `reach` how far to look, both in px.
    """
    spacing = width / KNOTS_PER_WIDTH
    count = int(np.ceil(reach / spacing))
    knots = np.arange(-count - 3, count + 4) * spacing
    inside = np.abs(x) < count * spacing
    x, value, weight = x[inside], value[inside], weight[inside]
    base = np.exp(-0.5 * (x / width) ** 2)
    # Splines that lie farther than 3 apart do not overlap: the matrix is a band.
    size = 2 * count + 3
    band, right = np.zeros((4, size)), np.zeros(size)
    _gather(x / spacing + count, value - base, weight, band, right)
    # Of a stripe that is narrow in a wide reach most splines have no sample.
    typical = float(np.median(band[3][band[3] > 0])) if np.any(band[3] > 0) else 0.0
    if typical == 0:
        return gaussian(width, reach)
    band += typical * (SMOOTHING * _roughness(size))
    band[3] += typical * RIDGE
    coefficients = scipy.linalg.solveh_banded(band, right)
    spline = scipy.interpolate.BSpline(knots, coefficients, 3)
    step = spacing / FINE
    grid: Array = np.arange(-count * FINE, count * FINE + 1) * np.float64(step)
    table = spline(grid) + np.exp(-0.5 * (grid / width) ** 2)
    return _settled(grid, np.asarray(table, dtype=np.float64), step, width)


@lru_cache(maxsize=64)
def _roughness(size: int) -> Array:
    """The sum of the squared third differences of `size` coefficients as the upper band (4, size) of a matrix."""
    rough = np.diff(np.eye(size), 3, axis=0)
    whole, band = rough.T @ rough, np.zeros((4, size))
    for k in range(4):
        band[3 - k, k:] = np.diagonal(whole, k)
    return band


@compiled
def _gather(place: Array, value: Array, weight: Array, band: Array, right: Array) -> None:  # pragma: no cover
    """Adds the samples' normal equations for cubic splines on whole numbers: upper `band` (4, size), `right` (size,).

    `place` (m,) counts from the low end of what is looked at, where the last piece of the first spline begins.
    """
    basis = np.empty(4)
    for n in range(len(place)):
        first = min(max(int(place[n]), 0), len(right) - 4)
        t = place[n] - first
        basis[0] = (1 - t) ** 3 / 6
        basis[1] = (3 * t**3 - 6 * t**2 + 4) / 6
        basis[2] = (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6
        basis[3] = t**3 / 6
        for i in range(4):
            weighted = weight[n] * basis[i]
            right[first + i] += weighted * value[n]
            for j in range(i, 4):
                band[3 - (j - i), first + j] += weighted * basis[j]


def _settled(grid: Array, table: Array, step: float, width: float) -> Shape:
    """The table with its ends at 0, its height 1, and 0 where the best Gaussian has its centre."""
    end = max(1, len(grid) // 20)
    low, high = float(table[:end].mean()), float(table[-end:].mean())
    table = table - np.interp(grid, (grid[0], grid[-1]), (low, high))
    centre = 0.0
    for _ in range(12):
        z = (grid - centre) / width
        g = np.exp(-0.5 * z * z)
        basis = np.stack([g, g * z / width, g * z * z / width, np.ones_like(g)], axis=1)
        height, shift, wider, _ = np.linalg.lstsq(basis, table, rcond=None)[0]
        if height <= 0:
            break
        centre += float(np.clip(shift / height, -0.5 * width, 0.5 * width))
        width *= float(np.exp(np.clip(wider / height / width, -0.3, 0.3)))
    # The ends of what is looked at fade, so that lines that move against each other fit without a step.
    fade = np.clip((np.minimum(grid - grid[0], grid[-1] - grid) / (0.06 * (grid[-1] - grid[0]))), 0.0, 1.0)
    table = table * fade * fade * (3 - 2 * fade)
    table = np.interp(grid + centre, grid, table, left=0.0, right=0.0)
    table = table / max(float(table.max()), 1e-9)
    return Shape(float(grid[0]), step, table, slope=np.gradient(table, step), width=width, learned=True)

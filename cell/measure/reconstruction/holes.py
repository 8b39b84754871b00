"""Small holes of an organised cloud, interpolated from the measured points around them and kept apart from these.

Each missing place gets the value at its middle of a quadratic surface, fitted to the measured points of a window about
as wide as the hole. Nothing is extrapolated beyond the scan, and nothing is filled where the points around do not lie
on one smooth surface: at a depth edge. Compiled.
"""

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.reconstruction.cloud import Array, Cloud, Filled, Indices

LARGEST = 0.0015
"""Widest hole that is filled unless told otherwise, m, across its narrower side."""
LEAST_POINTS = 12
"""A quadratic surface has six coefficients; with fewer points around, its residuals would say nothing."""
ROWS_ENOUGH = 24
"""About so many rows of a window are used; of wider ones every second, third …"""
MISFIT = 4.0
"""How many times the residuals' excess variance an interpolated point may be off by."""
EDGE_CHI2 = 4.0
"""Mean square of the residuals, in units of the noise, from which on the points around are no smooth surface."""


def fill_holes(cloud: Cloud, largest: float = LARGEST) -> Cloud:
    """The cloud with its holes up to `largest` m across interpolated in `filled`; 0 fills nothing.

    A hole's size is the distance between the measured points on both sides of it, in its narrower direction. The
    covariance of an interpolated point is the noise of the points around as the fit passes it on, raised where they
    scatter more than their noise, and the whole of its line's place along the sweep. Raises ValueError for a negative
    size.
    """
    if not largest >= 0:
        raise ValueError(f"the largest hole {largest} m must be 0 or greater")
    made = [_fill(cloud, lines, largest) for lines in cloud.each_sweep()]
    return replace(
        cloud,
        filled=Filled(
            np.concatenate([part.lines for part in made]),
            np.concatenate([part.rows for part in made]),
            np.concatenate([part.points for part in made]),
            np.concatenate([part.covariances for part in made]),
        ),
    )


def _fill(cloud: Cloud, lines: slice, largest: float) -> Filled:
    points = cloud.points[lines]
    measured = np.isfinite(points[:, :, 0])
    if largest == 0 or not measured.any() or min(measured.shape) < 3:
        return Filled()
    steps = _step(points[1:] - points[:-1]), _step(points[:, 1:] - points[:, :-1])
    if not (np.isfinite(steps[0]) and np.isfinite(steps[1])):
        return Filled()
    cells = _cells(measured, steps, largest)
    made, variances, ways = _interpolate(points, cloud.stripe_spread[lines], measured, cells)
    kept = np.isfinite(made[:, 0])
    where, ways = cells[kept], ways[kept]
    place = cloud.rail_spread[lines][where[:, 0]]
    covariances = variances[kept, None, None] * ways[:, :, None] * ways[:, None, :]
    return Filled(
        where[:, 0] + lines.start, where[:, 1], made[kept], covariances + place[:, :, None] * place[:, None, :]
    )


def _step(ways: Array) -> float:
    """Usual distance between neighbours, m; NaN when there are none."""
    lengths = np.linalg.norm(ways[:: max(1, len(ways) // 50)].reshape(-1, 3), axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(np.median(lengths)) if len(lengths) else np.nan


def _cells(measured: NDArray[np.bool_], steps: tuple[float, float], largest: float) -> Indices:
    """(n, 4) line and row of each place to fill, and the half sizes of its window in lines and rows."""
    labels, _ = scipy.ndimage.label(~measured, structure=np.ones((3, 3)))
    lines, rows = np.nonzero(labels)
    label = labels[lines, rows]
    boxes = scipy.ndimage.find_objects(labels)
    extents = np.array([[box[0].stop - box[0].start, box[1].stop - box[1].start] for box in boxes]).reshape(-1, 2)
    gaps = (extents + 1) * np.array(steps)
    width = gaps.min(axis=1)
    half = np.maximum([2, 3], 1 + np.ceil(width[:, None] / np.array(steps))).astype(np.intp)
    fits = (width <= largest)[label - 1]
    return np.asarray(np.column_stack([lines, rows, half[label - 1]])[fits], dtype=np.intp)


@compiled
def _solve(normal: Array, right: Array) -> bool:
    """Solve a symmetric system, of which the lower triangle is given, into `right` by Cholesky's way; False when it is
    not positive. Here because a compiled `np.linalg.solve` takes eight seconds to compile."""
    size = len(normal)
    for a in range(size):
        for b in range(a + 1):
            for k in range(b):
                normal[a, b] -= normal[a, k] * normal[b, k]
            if b < a:
                normal[a, b] /= normal[b, b]
        if not normal[a, a] > 0.0:
            return False
        normal[a, a] = np.sqrt(normal[a, a])
    for column in range(right.shape[1]):
        for a in range(size):
            for k in range(a):
                right[a, column] -= normal[a, k] * right[k, column]
            right[a, column] /= normal[a, a]
        for a in range(size - 1, -1, -1):
            for k in range(a + 1, size):
                right[a, column] -= normal[k, a] * right[k, column]
            right[a, column] /= normal[a, a]
    return True


@compiled
def _interpolate(
    points: Array, spread: NDArray[np.float32], measured: NDArray[np.bool_], cells: Indices
) -> tuple[Array, Array, Array]:
    """Points (n, 3) for the cells, NaN where none can be made; their variances (n,) along unit directions (n, 3)."""
    made = np.full((len(cells), 3), np.nan)
    variances = np.zeros(len(cells))
    ways = np.zeros((len(cells), 3))
    normal, right, basis = np.empty((6, 6)), np.empty((6, 2)), np.empty(6)
    for n in range(len(cells)):
        line, row, high, wide = cells[n]
        first, last = max(0, line - high), min(measured.shape[0], line + high + 1)
        stride = 1 + 2 * wide // ROWS_ENOUGH
        left, end = row - wide // stride * stride, min(measured.shape[1], row + wide + 1)
        while left < 0:
            left += stride
        count, before, behind, above, below = 0, 0, 0, 0, 0
        way, origin = np.zeros(3), np.zeros(3)
        for i in range(first, last):
            for j in range(left, end, stride):
                if measured[i, j]:
                    count += 1
                    before += i < line
                    behind += i > line
                    above += j < row
                    below += j > row
                    for k in range(3):
                        way[k] += spread[i, j, k]
                        origin[k] = points[i, j, k]
        length = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        if count < LEAST_POINTS or min(before, behind, above, below) == 0 or length == 0.0:
            continue
        way /= length
        normal[:], right[:] = 0.0, 0.0
        right[0, 0] = 1.0
        for i in range(first, last):
            for j in range(left, end, stride):
                if measured[i, j]:
                    weight = _weigh(spread[i, j], (i - line) / high, (j - row) / wide, basis)
                    height = _along(points[i, j], origin, way)
                    for a in range(6):
                        right[a, 1] += weight * basis[a] * height
                        for b in range(a + 1):
                            normal[a, b] += weight * basis[a] * basis[b]
        for a in range(6):
            # A window whose points lie on few lines leaves a coefficient open; it must not blow up the others.
            normal[a, a] *= 1.0 + 1e-9
        if not _solve(normal, right) or not right[0, 0] > 0.0:
            continue
        chi2, total = 0.0, 0.0
        for k in range(3):
            made[n, k] = origin[k]
        for i in range(first, last):
            for j in range(left, end, stride):
                if measured[i, j]:
                    weight = _weigh(spread[i, j], (i - line) / high, (j - row) / wide, basis)
                    fit, share = 0.0, 0.0
                    for a in range(6):
                        fit += basis[a] * right[a, 1]
                        share += weight * basis[a] * right[a, 0]
                    chi2 += weight * (_along(points[i, j], origin, way) - fit) ** 2 / (count - 6)
                    total += weight
                    for k in range(3):
                        made[n, k] += share * (points[i, j, k] - origin[k])
        if chi2 > EDGE_CHI2:
            made[n] = np.nan
            continue
        # What the surface has beyond a quadratic shows in the residuals, and does not average out in the hole.
        excess = max(0.0, chi2 - 1.0 - 2.0 * np.sqrt(2.0 / (count - 6)))
        variances[n] = right[0, 0] * max(1.0, chi2) + MISFIT * excess * count / total
        for k in range(3):
            ways[n, k] = way[k]
    return made, variances, ways


@compiled
def _along(point: Array, origin: Array, way: Array) -> float:
    """How far `point` lies from `origin` along `way`."""
    return float((point[0] - origin[0]) * way[0] + (point[1] - origin[1]) * way[1] + (point[2] - origin[2]) * way[2])


@compiled
def _weigh(spread: NDArray[np.float32], u: float, v: float, basis: Array) -> float:
    """1/σ² of a point, σ at least a nanometre, and in `basis` (6,) the quadratic's terms at its place."""
    basis[0], basis[1], basis[2], basis[3], basis[4], basis[5] = 1.0, u, v, u * u, u * v, v * v
    return 1.0 / max(1e-18, float(spread[0]) ** 2 + float(spread[1]) ** 2 + float(spread[2]) ** 2)

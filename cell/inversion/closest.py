"""Closest points on a triangle mesh: a grid of cells that know a triangle near them, then a walk over the mesh.

A look-up and a few triangles replace a tree search for every point. The grid also serves as a coarse distance field.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from cell.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

CELL = 0.0005
"""Edge of a cell, m, unless that makes more than `MOST_CELLS`."""
MOST_CELLS = 1_000_000
MARGIN = 0.004
"""How far the grid reaches beyond the mesh, m; points outside use the outermost cell."""


class Grid:
    """Cells around a mesh: `owner` (i, j, k) a triangle near each, `distance` (i, j, k) m of its middle from the mesh.

    `low` (3,) is the corner of the first cell and `cell` the edge, m.
    """

    def __init__(self, samples: Array, owners: Indices) -> None:
        low, high = samples.min(axis=0) - MARGIN, samples.max(axis=0) + MARGIN
        self.low: Array = low
        self.cell = float(max(CELL, np.cbrt(np.prod(high - low) / MOST_CELLS)))
        shape = np.ceil((high - low) / self.cell).astype(np.intp)
        inside = np.minimum(((samples - low) / self.cell).astype(np.intp), shape - 1)
        nearest = np.full(shape, -1, dtype=np.int32)
        nearest[inside[:, 0], inside[:, 1], inside[:, 2]] = np.arange(len(samples))
        where = scipy.ndimage.distance_transform_edt(nearest < 0, return_distances=False, return_indices=True)
        nearest = nearest[where[0], where[1], where[2]]
        middles = [low[k] + self.cell * (np.arange(shape[k]) + 0.5) for k in range(3)]
        squared = sum(
            (np.expand_dims(middle, [m for m in range(3) if m != k]) - samples[:, k][nearest]) ** 2
            for k, middle in enumerate(middles)
        )
        self.distance = np.sqrt(squared).astype(np.float32)
        self.owner = owners[nearest].astype(np.int32)


class Walk:
    """Which triangles meet at each corner: those of corner i are `fan[start[i]:start[i + 1]]`."""

    def __init__(self, corners: Array) -> None:
        # Corners at the same place are one, whatever the file says: the walk must get across.
        flat = np.ascontiguousarray(corners.reshape(-1, 3))
        _, merged = np.unique(np.round(flat / 1e-8).astype(np.int64), axis=0, return_inverse=True)
        self.corner_of: NDArray[np.int64] = merged.reshape(-1, 3).astype(np.int64)
        order = np.argsort(self.corner_of.ravel(), kind="stable")
        self.fan = (order // 3).astype(np.int32)
        self.start = np.searchsorted(self.corner_of.ravel()[order], np.arange(merged.max() + 2)).astype(np.int32)


@compiled
def closest(
    points: Array,
    low: Array,
    cell: float,
    owner: NDArray[np.int32],
    corners: Array,
    corner_of: NDArray[np.int64],
    start: NDArray[np.int32],
    fan: NDArray[np.int32],
) -> tuple[Array, Indices]:
    """For each point (n, 3) the closest point of the mesh (corners (m, 3, 3)), and the triangle on which it lies."""
    feet = np.empty_like(points)
    hit = np.empty(len(points), dtype=np.intp)
    foot, weights = np.empty(3), np.empty(3)
    at = np.empty(3, dtype=np.intp)
    better, better_weights = np.empty(3), np.empty(3)
    for n in range(len(points)):
        for i in range(3):
            at[i] = min(max(int((points[n, i] - low[i]) / cell), 0), owner.shape[i] - 1)
        best = int(owner[at[0], at[1], at[2]])
        distance = to_triangle(points[n], corners, best, foot, weights)
        for _ in range(100):
            if min(weights[0], weights[1], weights[2]) > 0.0:
                break
            pivot = corner_of[best, np.argmax(weights)]
            left = best
            for place in range(start[pivot], start[pivot + 1]):
                triangle = int(fan[place])
                if triangle == left:
                    continue
                other = to_triangle(points[n], corners, triangle, better, better_weights)
                if other < distance:
                    distance, best = other, triangle
                    # One by one: for slices numba compiles the text of an error, which takes 3 s.
                    for i in range(3):
                        foot[i], weights[i] = better[i], better_weights[i]
            if best == left:
                break
        hit[n] = best
        for i in range(3):
            feet[n, i] = foot[i]
    return feet, hit


@compiled
def to_triangle(p: Array, corners: Array, t: int, foot: Array, weights: Array) -> float:
    """Squared distance (m²) of `p` from triangle `t`; fills `foot` (3,) and its barycentric `weights` (3,).

    The regions are Ericson's, Real-Time Collision Detection 5.1.5.
    """
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = corners[t, 1, i] - corners[t, 0, i], corners[t, 2, i] - corners[t, 0, i]
        d1 += ab * (p[i] - corners[t, 0, i])
        d2 += ac * (p[i] - corners[t, 0, i])
        d3 += ab * (p[i] - corners[t, 1, i])
        d4 += ac * (p[i] - corners[t, 1, i])
        d5 += ab * (p[i] - corners[t, 2, i])
        d6 += ac * (p[i] - corners[t, 2, i])
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    u = v = w = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        u = 1.0
    elif d3 >= 0.0 and d4 <= d3:
        v = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        u = 1.0 - v
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        u = 1.0 - w
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
        u = 1.0 - v - w
    weights[0], weights[1], weights[2] = u, v, w
    squared = 0.0
    for i in range(3):
        foot[i] = u * corners[t, 0, i] + v * corners[t, 1, i] + w * corners[t, 2, i]
        squared += (p[i] - foot[i]) ** 2
    return squared

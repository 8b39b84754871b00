"""Closest points on a triangle mesh: a grid of cells that know a triangle near them, then a walk over the mesh.

A look-up and a few triangles replace a tree search for every point. The grid also serves as a coarse distance field.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from cell.base.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Point = tuple[float, float, float]

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
    within: float,
    low: Array,
    cell: float,
    owner: NDArray[np.int32],
    corners: Array,
    normals: Array,
    corner_of: NDArray[np.int64],
    start: NDArray[np.int32],
    fan: NDArray[np.int32],
) -> tuple[Indices, Indices, Array, Array, Array, NDArray[np.bool_]]:
    """Of the points (n, 3) those within `within` m of the mesh (corners (m, 3, 3), unit normals (m, 3)).

    Their indices, the triangles on which their closest points lie, those points and the normals there, how far the
    points are along the normal, and whether the shortest way runs along it.
    """
    many = len(points)
    chosen, hit = np.empty(many, dtype=np.intp), np.empty(many, dtype=np.intp)
    feet, ups = np.empty((many, 3)), np.empty((many, 3))
    heights, upright = np.empty(many), np.empty(many, dtype=np.bool_)
    at = np.empty(3, dtype=np.intp)
    count = 0
    for n in range(many):
        p = points[n, 0], points[n, 1], points[n, 2]
        for i in range(3):
            at[i] = min(max(int((points[n, i] - low[i]) / cell), 0), owner.shape[i] - 1)
        best = int(owner[at[0], at[1], at[2]])
        distance, foot, weights = to_triangle(
            p,
            (corners[best, 0, 0], corners[best, 0, 1], corners[best, 0, 2]),
            (corners[best, 1, 0], corners[best, 1, 1], corners[best, 1, 2]),
            (corners[best, 2, 0], corners[best, 2, 1], corners[best, 2, 2]),
        )
        for _ in range(100):
            if min(weights[0], weights[1], weights[2]) > 0.0:
                break
            largest = 0 if weights[0] >= weights[1] else 1
            largest = largest if weights[largest] >= weights[2] else 2
            pivot = corner_of[best, largest]
            left = best
            for place in range(start[pivot], start[pivot + 1]):
                t = int(fan[place])
                if t == left:
                    continue
                other, better, better_weights = to_triangle(
                    p,
                    (corners[t, 0, 0], corners[t, 0, 1], corners[t, 0, 2]),
                    (corners[t, 1, 0], corners[t, 1, 1], corners[t, 1, 2]),
                    (corners[t, 2, 0], corners[t, 2, 1], corners[t, 2, 2]),
                )
                if other < distance:
                    distance, best, foot, weights = other, t, better, better_weights
            if best == left:
                break
        if not distance <= within * within:
            continue
        x, y, z = p[0] - foot[0], p[1] - foot[1], p[2] - foot[2]
        nx, ny, nz = normals[best, 0], normals[best, 1], normals[best, 2]
        height = x * nx + y * ny + z * nz
        aside = np.sqrt((x - height * nx) ** 2 + (y - height * ny) ** 2 + (z - height * nz) ** 2)
        chosen[count], hit[count], heights[count] = n, best, height
        upright[count] = aside <= 2e-5 + 0.3 * abs(height)
        feet[count, 0], feet[count, 1], feet[count, 2] = foot
        ups[count, 0], ups[count, 1], ups[count, 2] = nx, ny, nz
        count += 1
    return chosen[:count], hit[:count], feet[:count], ups[:count], heights[:count], upright[:count]


@compiled
def to_triangle(p: Point, a: Point, b: Point, c: Point) -> tuple[float, Point, Point]:
    """Squared distance (m²) of `p` from the triangle a, b, c, the closest point and its barycentric weights.

    The regions are Ericson's, Real-Time Collision Detection 5.1.5. Tuples: references to arrays are counted at each
    call, which takes longer than the rest.
    """
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = b[i] - a[i], c[i] - a[i]
        d1 += ab * (p[i] - a[i])
        d2 += ac * (p[i] - a[i])
        d3 += ab * (p[i] - b[i])
        d4 += ac * (p[i] - b[i])
        d5 += ab * (p[i] - c[i])
        d6 += ac * (p[i] - c[i])
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
    x = u * a[0] + v * b[0] + w * c[0]
    y = u * a[1] + v * b[1] + w * c[1]
    z = u * a[2] + v * b[2] + w * c[2]
    squared = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2
    return squared, (x, y, z), (u, v, w)

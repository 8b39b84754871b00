"""A triangle mesh with a box tree, for the light plane's section and for shadow rays.

The tree is complete and implicit (children of node i are 2i+1 and 2i+2), so it is built by plain array operations;
places in the last leaves that hold no triangle are filled with points at the origin, which nothing can hit.
"""

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled

Vector = NDArray[np.float64]
LEAF = 8
"""Triangles in a leaf."""


class Mesh:
    """Triangles: `vertices` (n, 3) in m, `triangles` (m, 3) vertex numbers. Orientation does not matter.

    `corners` (m, 3, 3) are the triangles' vertices in tree order, `low`, `high` (nodes, 3) the tree's boxes;
    `leaf_centres`, `leaf_normals` (k, 3) and `leaf_sizes` (k,), of median `leaf_size`, describe the leaves for coarse
    shading; `middle` (3,) is their mean.
    """

    def __init__(self, vertices: Vector, triangles: NDArray[np.integer]) -> None:
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.triangles = np.ascontiguousarray(triangles, dtype=np.int64)
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or not np.isfinite(self.vertices).all():
            raise ValueError(f"vertices of shape {self.vertices.shape}: need a finite (n, 3) array in m")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3 or not len(self.triangles):
            raise ValueError(f"triangles of shape {self.triangles.shape}: need an (m, 3) array with m above 0")
        if self.triangles.min() < 0 or self.triangles.max() >= len(self.vertices):
            raise ValueError(f"a triangle names a vertex outside 0…{len(self.vertices) - 1}")
        corners = self.vertices[self.triangles]
        order = _tree_order(corners.mean(axis=1))
        used = order >= 0
        self.corners = np.ascontiguousarray(np.where(used[:, None, None], corners[order], 0.0))
        self.low, self.high = _tree(self.corners, used)
        crosses = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        sums = crosses.reshape(-1, LEAF, 3).sum(axis=1)
        filled: NDArray[np.bool_] = np.asarray(used.reshape(-1, LEAF).any(axis=1))
        low, high = self.low[-len(filled) :][filled], self.high[-len(filled) :][filled]
        lengths = np.linalg.norm(sums[filled], axis=1, keepdims=True)
        self.leaf_normals: Vector = sums[filled] / np.maximum(lengths, 1e-300)
        self.leaf_centres = (low + high) / 2
        self.leaf_sizes: Vector = (high - low).max(axis=1)
        self.middle: Vector = self.leaf_centres.mean(axis=0)
        self.leaf_size = float(np.median(self.leaf_sizes))

    def section(self, normal: Vector, distance: float) -> tuple[Vector, Vector]:
        """Cut by the plane normal·P = distance: segments (k, 2, 3) and unit surface normals (k, 3)."""
        capacity = 4096
        while True:
            segments = np.empty((capacity, 2, 3))
            normals = np.empty((capacity, 3))
            count = cut(self.corners, self.low, self.high, normal, distance, segments=segments, normals=normals)
            if count <= capacity:
                return segments[:count], normals[:count]
            capacity = count

    def hide(self, points: Vector, eye: Vector, start: float, seen: NDArray[np.bool_]) -> None:
        """Clear `seen` (n,) where the mesh stands between `points` (n, 3) and `eye` (3,), all in the mesh frame. Hits
        nearer than `start` (m) to the point do not count; a negative `start` makes a touching mesh count."""
        shadow(self.corners, self.low, self.high, points=np.ascontiguousarray(points), eye=eye, start=start, seen=seen)


def _tree_order(centres: Vector) -> NDArray[np.int64]:
    """Split at the median along the longest side, level by level; places left over at the end hold -1."""
    leaves = 1
    while leaves * LEAF < len(centres):
        leaves *= 2
    order = np.full(leaves * LEAF, -1, dtype=np.int64)
    order[: len(centres)] = np.arange(len(centres))
    # An axis a row: numpy's reductions along a run of three numbers are many times slower than along long ones.
    padded = np.full((3, leaves * LEAF), np.inf)
    padded[:, : len(centres)] = centres.T
    blocks = 1
    while blocks < leaves:
        points = padded.reshape(3, blocks, -1)
        # Places without a triangle are infinite, and never the least, but never to be the greatest either.
        spans = np.where(np.isfinite(points), points, -np.inf).max(axis=2) - points.min(axis=2)
        keys = np.take_along_axis(points, spans.argmax(axis=0)[None, :, None], axis=0)[0]
        inner = keys.argsort(axis=1, kind="stable")
        padded = np.take_along_axis(points, inner[None], axis=2)
        order = np.take_along_axis(order.reshape(blocks, -1), inner, axis=1).ravel()
        blocks *= 2
    return order


def _tree(corners: Vector, used: NDArray[np.bool_]) -> tuple[Vector, Vector]:
    low = np.where(used[:, None], corners.min(axis=1), np.inf).reshape(-1, LEAF, 3).min(axis=1)
    high = np.where(used[:, None], corners.max(axis=1), -np.inf).reshape(-1, LEAF, 3).max(axis=1)
    lows, highs = [low], [high]
    while len(lows[0]) > 1:
        lows.insert(0, lows[0].reshape(-1, 2, 3).min(axis=1))
        highs.insert(0, highs[0].reshape(-1, 2, 3).max(axis=1))
    return np.concatenate(lows), np.concatenate(highs)


@compiled
def cut(
    corners: Vector, low: Vector, high: Vector, normal: Vector, distance: float, segments: Vector, normals: Vector
) -> int:
    """Fill `segments` and `normals`; returns how many cuts there are, also those beyond the capacity."""
    first_leaf = low.shape[0] // 2
    stack = np.empty(64, dtype=np.int64)
    stack[0] = 0
    depth = 1
    count = 0
    height = np.empty(3)
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if low[node, 0] > high[node, 0]:
            continue
        near = -distance
        far = -distance
        for axis in range(3):
            a = normal[axis] * low[node, axis]
            b = normal[axis] * high[node, axis]
            near += min(a, b)
            far += max(a, b)
        if near > 0.0 or far < 0.0:
            continue
        if node < first_leaf:
            stack[depth] = 2 * node + 1
            stack[depth + 1] = 2 * node + 2
            depth += 2
            continue
        start = (node - first_leaf) * LEAF
        for t in range(start, start + LEAF):
            for i in range(3):
                height[i] = (
                    normal[0] * corners[t, i, 0]
                    + normal[1] * corners[t, i, 1]
                    + normal[2] * corners[t, i, 2]
                    - distance
                )
            found = 0
            for i in range(3):
                j = (i + 1) % 3
                if (height[i] >= 0.0) != (height[j] >= 0.0):
                    if count < segments.shape[0]:
                        share = height[i] / (height[i] - height[j])
                        for axis in range(3):
                            segments[count, found, axis] = corners[t, i, axis] + share * (
                                corners[t, j, axis] - corners[t, i, axis]
                            )
                    found += 1
            if found == 2:
                if count < segments.shape[0]:
                    ax, ay, az = corners[t, 0, 0], corners[t, 0, 1], corners[t, 0, 2]
                    ex, ey, ez = corners[t, 1, 0] - ax, corners[t, 1, 1] - ay, corners[t, 1, 2] - az
                    fx, fy, fz = corners[t, 2, 0] - ax, corners[t, 2, 1] - ay, corners[t, 2, 2] - az
                    nx, ny, nz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
                    length = np.sqrt(nx * nx + ny * ny + nz * nz)
                    normals[count, 0] = nx / length
                    normals[count, 1] = ny / length
                    normals[count, 2] = nz / length
                count += 1
    return count


@compiled
def met_after(corners: Vector, px: float, py: float, pz: float, dx: float, dy: float, dz: float) -> float:
    """How far from p along d the triangle `corners` (3, 3) is met; infinite where it is not (Möller–Trumbore)."""
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    e1x, e1y, e1z = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    e2x, e2y, e2z = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    hx, hy, hz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
    det = e1x * hx + e1y * hy + e1z * hz
    if det == 0.0:
        return np.inf
    sx, sy, sz = px - ax, py - ay, pz - az
    u = (sx * hx + sy * hy + sz * hz) / det
    if u < 0.0 or u > 1.0:
        return np.inf
    qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    v = (dx * qx + dy * qy + dz * qz) / det
    if v < 0.0 or u + v > 1.0:
        return np.inf
    return float((e2x * qx + e2y * qy + e2z * qz) / det)


@compiled
def shadow(
    corners: Vector, low: Vector, high: Vector, points: Vector, eye: Vector, start: float, seen: NDArray[np.bool_]
) -> None:
    """Clear `seen[i]` where any triangle lies between `points[i]` and `eye`."""
    first_leaf = low.shape[0] // 2
    stack = np.empty(64, dtype=np.int64)
    for i in range(points.shape[0]):
        if not seen[i]:
            continue
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        dx, dy, dz = eye[0] - px, eye[1] - py, eye[2] - pz
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        ix = 1.0 / (dx if abs(dx) > 1e-12 else 1e-12)
        iy = 1.0 / (dy if abs(dy) > 1e-12 else 1e-12)
        iz = 1.0 / (dz if abs(dz) > 1e-12 else 1e-12)
        stack[0] = 0
        depth = 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            a = (low[node, 0] - px) * ix
            b = (high[node, 0] - px) * ix
            enter = min(a, b)
            leave = max(a, b)
            a = (low[node, 1] - py) * iy
            b = (high[node, 1] - py) * iy
            enter = max(enter, min(a, b))
            leave = min(leave, max(a, b))
            a = (low[node, 2] - pz) * iz
            b = (high[node, 2] - pz) * iz
            enter = max(enter, min(a, b))
            leave = min(leave, max(a, b))
            if not (leave >= enter - 1e-9 and leave >= start and enter <= length and low[node, 0] <= high[node, 0]):
                continue
            if node < first_leaf:
                stack[depth] = 2 * node + 1
                stack[depth + 1] = 2 * node + 2
                depth += 2
                continue
            begin = (node - first_leaf) * LEAF
            for t in range(begin, begin + LEAF):
                distance = met_after(corners[t], px, py, pz=pz, dx=dx, dy=dy, dz=dz)
                if start < distance < length - 1e-6:
                    seen[i] = False
                    break
            if not seen[i]:
                break

"""A surface from a mesh file, as the world needs it: what the cameras see of it, and the ground that a part meets.

The ground is a height field: the highest that the mesh is above each place, from a raster fine enough that what lies
between its points is less than what a part can feel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled
from sim_backends.world.bodies.surfaces import Surface, SurfaceMesh

Floats = NDArray[np.float64]
Faces = NDArray[np.int64]

FINEST, MOST_POINTS = 1e-4, 1200
"""Raster of the height field: its step, m, at least, and points along the longer side at most."""
COARSEST = 1e-3
"""Triangles are divided until no side is longer, m, or than a hundredth of the mesh: ambient light is drawn by them."""
UNITS = {"m": 1.0, "mm": 1e-3}


@dataclass(frozen=True, eq=False)
class OwnSurface:
    """`ground` is the height field, `vertices` (n, 3) m and `triangles` (m, 3) the mesh without sides, frame S."""

    ground: Surface
    vertices: Floats
    triangles: Faces

    def walled(self, table: tuple[float, float, float]) -> SurfaceMesh:
        """The mesh with sides from its open borders down to the table, z = a + b x + c y in S."""
        edges = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        single, count = np.unique(edges, axis=0, return_counts=True)
        border = single[count == 1]
        vertices, faces = self.vertices, self.triangles
        if len(border):
            a, b, c = table
            rim = np.unique(border)
            feet = vertices[rim].copy()
            feet[:, 2] = np.minimum(feet[:, 2], a + b * feet[:, 0] + c * feet[:, 1])
            below = np.searchsorted(rim, border) + len(vertices)
            first, second = border.T
            sides = [np.stack([first, below[:, 0], below[:, 1]], -1), np.stack([first, below[:, 1], second], -1)]
            vertices, faces = np.concatenate([vertices, feet]), np.concatenate([faces, *sides])
        return SurfaceMesh(vertices, faces.astype(np.int32))


def own_surface(path: str, unit: str) -> OwnSurface:
    """The surface in a mesh file; the last few are kept. Raises ValueError when there is no mesh in it."""
    try:
        content = sha256(Path(path).read_bytes()).digest()
    except OSError as error:
        raise ValueError(f"the surface's mesh {path} cannot be read: {error.strerror}") from error
    return _read(path, content, unit)


@lru_cache(maxsize=4)
def _read(path: str, content: bytes, unit: str) -> OwnSurface:
    import trimesh
    from trimesh.remesh import subdivide_to_size

    try:
        mesh = trimesh.load_mesh(path, process=True)
        vertices = UNITS[unit] * np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int64)
        if not len(faces) or not np.isfinite(vertices).all():
            raise ValueError(f"{len(faces)} triangles, or corners that are not numbers")
    except Exception as error:  # every reader of trimesh raises its own
        raise ValueError(f"the surface's mesh {path} cannot be read: {error}") from error
    longest = max(COARSEST, float(np.ptp(vertices, axis=0).max()) / 100.0)
    divide: Any = subdivide_to_size
    vertices, faces = divide(vertices, faces, longest, max_iter=20)
    merged = trimesh.Trimesh(vertices, faces, process=True)
    vertices, faces = np.asarray(merged.vertices, dtype=np.float64), np.asarray(merged.faces, dtype=np.int64)
    return OwnSurface(_ground(Path(path).stem, vertices, faces), vertices, faces)


def _ground(name: str, vertices: Floats, faces: Faces) -> Surface:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = max(FINEST, float((high - low)[:2].max()) / MOST_POINTS)
    nx, ny = (int(np.ceil(side / step)) + 1 for side in (high - low)[:2])
    heights = np.full((nx, ny), np.nan)
    raster(vertices[faces], low[:2].copy(), step, heights)

    def relief(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        u, v = (np.asarray(x) - low[0]) / step, (np.asarray(y) - low[1]) / step
        i = np.clip(np.floor(np.nan_to_num(u)), 0, nx - 2).astype(np.intp)
        j = np.clip(np.floor(np.nan_to_num(v)), 0, ny - 2).astype(np.intp)
        a, b = u - i, v - j
        h00, h10, h01, h11 = heights[i, j], heights[i + 1, j], heights[i, j + 1], heights[i + 1, j + 1]
        h = (1 - a) * ((1 - b) * h00 + b * h01) + a * ((1 - b) * h10 + b * h11)
        gx = ((1 - b) * (h10 - h00) + b * (h11 - h01)) / step
        gy = ((1 - a) * (h01 - h00) + a * (h11 - h10)) / step
        return h, gx, gy

    half, centre = 0.5 * (high - low), 0.5 * (high + low)
    return Surface(
        name, relief, float(half[0]), float(half[1]), centre=(float(centre[0]), float(centre[1])), top=float(high[2])
    )  # fmt: skip


@compiled
def raster(corners: Floats, low: Floats, step: float, heights: Floats) -> None:
    """Fill `heights` (nx, ny) with the highest z of the triangles (n, 3, 3) at low + step (i, j)."""
    for t in range(corners.shape[0]):
        ax, ay, az = corners[t, 0, 0] - low[0], corners[t, 0, 1] - low[1], corners[t, 0, 2]
        bx, by, bz = corners[t, 1, 0] - low[0], corners[t, 1, 1] - low[1], corners[t, 1, 2]
        cx, cy, cz = corners[t, 2, 0] - low[0], corners[t, 2, 1] - low[1], corners[t, 2, 2]
        double_area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(double_area) < 1e-18:
            continue
        first_i = max(int(np.ceil(min(ax, bx, cx) / step - 1e-6)), 0)
        last_i = min(int(np.floor(max(ax, bx, cx) / step + 1e-6)), heights.shape[0] - 1)
        first_j = max(int(np.ceil(min(ay, by, cy) / step - 1e-6)), 0)
        last_j = min(int(np.floor(max(ay, by, cy) / step + 1e-6)), heights.shape[1] - 1)
        for i in range(first_i, last_i + 1):
            for j in range(first_j, last_j + 1):
                x, y = i * step, j * step
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / double_area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / double_area
                wc = 1.0 - wa - wb
                if wa < -1e-6 or wb < -1e-6 or wc < -1e-6:
                    continue
                z = wa * az + wb * bz + wc * cz
                if not heights[i, j] >= z:
                    heights[i, j] = z

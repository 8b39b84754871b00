"""Rays against a mesh: what they meet first, and whether anything lies between an eye and a point of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError
from drivers.packages import lacking

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

ABOVE: Array = np.array([0.0, 0.0, 1.0])
"""The direction of an eye straight above, surface frame."""
SMOOTH = 0.9
"""Cosine of the angle (26 degrees) up to which neighbouring triangles are taken for one smooth surface."""
MOST_MEETING = 400
"""Triangles that meet in a corner, from which on it is taken as it is: the middle of a flat cap."""
NEAR = 2e-5
"""Hits nearer to each other than this along a ray are one, m."""


class Rays:
    """Rays against the triangles of `vertices` (n, 3) m and `faces` (m, 3)."""

    def __init__(self, vertices: Array, faces: Faces) -> None:
        if missing := lacking("embreex", "embreex"):
            raise ConfigError(f"what a camera sees of the body cannot be found: {missing}")
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.normals: Array = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self._corners = corners
        self._faces = faces
        self._smooth: Array | None = None
        made: Any = trimesh.Trimesh(vertices, faces, process=False)
        self._rays: Any = RayMeshIntersector(made)

    def hits(self, origins: Array, ways: Array) -> tuple[NDArray[np.int64], Array]:
        """The first triangle (n,) that rays from `origins` (n, 3) along unit `ways` (n, 3) meet, −1 for none, and how
        far away it is, m."""
        triangle = np.asarray(self._rays.intersects_first(origins, ways), dtype=np.int64)
        distance = np.full(len(origins), np.inf)
        hit = np.flatnonzero(triangle >= 0)
        # By the triangle's own plane, in double precision: the library answers in single.
        normal, first = self.normals[triangle[hit]], self._corners[triangle[hit], 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.einsum("ni,ni->n", first - origins[hit], normal) / np.einsum("ni,ni->n", ways[hit], normal)
        distance[hit] = np.where(np.isfinite(found), found, np.inf)
        return triangle, distance

    def open_between(self, points: Array, eyes: Array) -> NDArray[np.bool_]:
        """(n,) whether nothing lies between each of `eyes` (n, 3) and the point (n, 3) on the mesh."""
        return np.asarray(self.behind(points, eyes) > -NEAR)

    def behind(self, points: Array, eyes: Array) -> Array:
        """(n,) how far behind the point (n, 3) that lies which each of `eyes` (n, 3) sees there first, m."""
        ways = points - eyes
        length = np.linalg.norm(ways, axis=1)
        return np.asarray(self.hits(eyes, ways / length[:, None])[1] - length)

    def smooth_normals(self, triangles: NDArray[np.int64], points: Array) -> Array:
        """Unit normals (n, 3) at points on triangles (n,), of the smooth surface that the triangles stand for.

        By the flat triangles' own normals a round part would seem to tell how it is turned: only its facets do.
        """
        if self._smooth is None:
            self._smooth = _corner_normals(self._corners, self._faces, self.normals)
        a, b, c = self._corners[triangles].transpose(1, 0, 2)
        whole = np.cross(b - a, c - a)
        square = np.einsum("ni,ni->n", whole, whole)
        second = np.einsum("ni,ni->n", np.cross(points - a, c - a), whole) / square
        third = np.einsum("ni,ni->n", np.cross(b - a, points - a), whole) / square
        shares = np.stack([1.0 - second - third, second, third], axis=1)
        made = np.einsum("nk,nki->ni", shares, self._smooth[triangles])
        return np.asarray(made / np.linalg.norm(made, axis=1, keepdims=True))


def _corner_normals(corners: Array, faces: Faces, normals: Array) -> Array:
    """(m, 3, 3) normals at the corners of each triangle: the mean of those that meet there and are nearly as steep,
    weighted by their angles."""
    sides = np.roll(corners, -1, axis=1) - corners
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    angles = np.arccos(np.clip(-np.einsum("nki,nki->nk", sides, np.roll(sides, 1, axis=1)), -1.0, 1.0)).ravel()
    at = faces.ravel()
    order = np.argsort(at, kind="stable")
    count = np.bincount(at)
    begin = np.cumsum(count) - count
    few = np.where(count[at] <= MOST_MEETING, count[at], 0)
    mine = np.repeat(np.arange(len(at)), few)
    place = np.arange(len(mine)) - np.repeat(np.cumsum(few) - few, few)
    other = order[begin[at[mine]] + place]
    near = np.einsum("ni,ni->n", normals[mine // 3], normals[other // 3]) > SMOOTH
    made = np.array(np.repeat(1e-9 * normals, 3, axis=0))
    for k in range(3):
        made[:, k] += np.bincount(mine[near], angles[other[near]] * normals[other[near] // 3, k], minlength=len(at))
    made[few == 0] = normals[np.flatnonzero(few == 0) // 3]
    return np.asarray((made / np.linalg.norm(made, axis=1, keepdims=True)).reshape(-1, 3, 3))

"""What of a mesh is seen: first hits of rays, and which triangles lie open to a direction."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

ABOVE: Array = np.array([0.0, 0.0, 1.0])
"""The direction of an eye straight above, surface frame."""
NEAR = 2e-5
"""Hits nearer to each other than this along a ray are one, m."""


class Rays:
    """Rays against the triangles of `vertices` (n, 3) m and `faces` (m, 3)."""

    def __init__(self, vertices: Array, faces: Faces) -> None:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.normals: Array = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self._first = corners[:, 0]
        made: Any = trimesh.Trimesh(vertices, faces, process=False)
        self._rays: Any = RayMeshIntersector(made)

    def hits(self, origins: Array, ways: Array) -> tuple[NDArray[np.int64], Array]:
        """The first triangle (n,) that rays from `origins` (n, 3) along unit `ways` (n, 3) meet, −1 for none, and how
        far away it is, m."""
        triangle = np.asarray(self._rays.intersects_first(origins, ways), dtype=np.int64)
        distance = np.full(len(origins), np.inf)
        hit = np.flatnonzero(triangle >= 0)
        # By the triangle's own plane, in double precision: the library answers in single.
        normal, first = self.normals[triangle[hit]], self._first[triangle[hit]]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.einsum("ni,ni->n", first - origins[hit], normal) / np.einsum("ni,ni->n", ways[hit], normal)
        distance[hit] = np.where(np.isfinite(found), found, np.inf)
        return triangle, distance

    def open_between(self, points: Array, eyes: Array) -> NDArray[np.bool_]:
        """(n,) whether nothing lies between each of `eyes` (n, 3) and the point (n, 3) on the mesh."""
        ways = points - eyes
        length = np.linalg.norm(ways, axis=1)
        _, met = self.hits(eyes, ways / length[:, None])
        return np.asarray(met > length - NEAR)


def seen_from(vertices: Array, faces: Faces, towards: Array) -> NDArray[np.bool_]:
    """(m,) which triangles' middles lie open to an eye far away in the unit direction `towards` (3,)."""
    rays = Rays(vertices, faces)
    middles = vertices[faces].mean(axis=1)
    far = 2.0 * float(np.ptp(vertices, axis=0).max()) + 0.1
    facing = rays.normals @ towards > 1e-3
    seen = np.zeros(len(faces), dtype=np.bool_)
    seen[facing] = rays.open_between(middles[facing], middles[facing] + far * towards)
    return seen


def refined(vertices: Array, faces: Faces, longest: float) -> tuple[Array, Faces]:
    """The same surface in triangles whose sides are at most `longest` m. Neighbours keep sharing their corners."""
    for _ in range(20):
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, owner = np.unique(sides, axis=0, return_inverse=True)
        split = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) > longest
        if not split.any():
            break
        number = np.full(len(edges), -1)
        number[split] = len(vertices) + np.arange(int(split.sum()))
        vertices = np.concatenate([vertices, vertices[edges[split]].mean(axis=1)])
        faces = _divided(faces, number[owner].reshape(-1, 3))
    return vertices, faces


def _divided(faces: Faces, middles: Faces) -> Faces:
    """Triangles with a new corner `middles` (m, 3) in the side after each corner, −1 for a side that stays whole."""
    made = [faces[(middles < 0).all(axis=1)]]
    count = (middles >= 0).sum(axis=1)
    for turn in range(3):
        a, b, c = np.roll(faces, -turn, axis=1).T
        ab, bc, ca = np.roll(middles, -turn, axis=1).T
        one = (count == 1) & (ab >= 0)
        made += [np.stack([a, ab, c], 1)[one], np.stack([ab, b, c], 1)[one]]
        two = (count == 2) & (ca < 0)
        made += [np.stack([ab, b, bc], 1)[two], np.stack([a, ab, c], 1)[two], np.stack([ab, bc, c], 1)[two]]
    a, b, c = faces[count == 3].T
    ab, bc, ca = middles[count == 3].T
    made += [np.stack(each, 1) for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(made)

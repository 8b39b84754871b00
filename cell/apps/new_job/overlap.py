"""Bodies of one mesh that overlap: which do, and which of their faces lie in one another.

What lies inside a body is hidden by its outside and needs no care. Two faces at one place are both seen: one counts.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cell.apps.new_job.mesh_file import MeshBody
from cell.apps.new_job.rays import ABOVE, Array, Faces, Rays

APART = 1e-4
"""Share of a body's size by which another has to reach into it to overlap: bodies that touch do not."""


def overlapping(bodies: Sequence[MeshBody]) -> list[tuple[int, int]]:
    """Pairs of numbers of bodies that reach into each other, or of which one lies inside the other."""
    pairs = [
        pair
        for pair in itertools.combinations(range(len(bodies)), 2)
        if _boxes_meet(*(bodies[k].vertices for k in pair))
    ]
    rays = {k: Rays(bodies[k].vertices, bodies[k].triangles) for k in {k for pair in pairs for k in pair}}
    return [
        (i, j) for i, j in pairs if _enters(bodies[i], bodies[j], rays[j]) or _enters(bodies[j], bodies[i], rays[i])
    ]


def _boxes_meet(one: Array, other: Array) -> bool:
    return bool((one.min(axis=0) <= other.max(axis=0)).all() and (other.min(axis=0) <= one.max(axis=0)).all())


def _enters(body: MeshBody, other: MeshBody, rays: Rays) -> bool:
    """Whether `body` has places of its surface inside `other`, which `rays` meet; where that is open, crosses it."""
    apart = APART * float(other.size.max())
    corners = body.vertices[body.triangles]
    begin, way = corners.reshape(-1, 3), (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    length = np.linalg.norm(way, axis=1)
    way /= length[:, None]
    _, met = rays.hits(begin, way)
    crossed = np.flatnonzero((met > apart) & (met < length - apart))
    if not other.closed:
        return len(crossed) > 0
    # A little inside `body` itself, so that faces that only touch do not count.
    inwards = np.cross(corners[:, 2] - corners[:, 0], corners[:, 1] - corners[:, 0])
    inwards *= apart / np.linalg.norm(inwards, axis=1, keepdims=True)
    at = [
        begin[crossed] + (met[crossed] + step)[:, None] * way[crossed] + inwards[crossed // 3]
        for step in (-apart, apart)
    ]
    places = np.concatenate([corners.mean(axis=1) + inwards, *at])
    triangle, met = rays.hits(places, np.tile(ABOVE, (len(places), 1)))
    return bool(((triangle >= 0) & (met > 0.1 * apart) & (rays.normals[triangle] @ ABOVE > 0.0)).any())


def before(vertices: Array, faces: Faces) -> tuple[NDArray[np.intp], list[Rays | None]]:
    """(m,) the body of each triangle, and for each body the earlier ones that its box meets, None where there are none.

    A place of a body that lies on one of those is there twice.
    """
    links = coo_matrix(
        (np.ones(2 * len(faces)), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())), shape=(len(vertices),) * 2
    )
    _, label = connected_components(links, directed=False)
    body = np.unique(label[faces[:, 0]], return_inverse=True)[1].reshape(-1).astype(np.intp)
    parts = [faces[body == k] for k in range(int(body.max(initial=-1)) + 1)]
    corners = [vertices[part.ravel()] for part in parts]
    earlier: list[Rays | None] = []
    for k in range(len(parts)):
        met = [parts[j] for j in range(k) if _boxes_meet(corners[k], corners[j])]
        earlier.append(Rays(vertices, np.concatenate(met)) if met else None)
    return body, earlier

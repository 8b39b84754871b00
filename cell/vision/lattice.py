"""Order among found dots: grows a lattice from neighbour to neighbour, so that perspective does not matter.

Lattice places here are whole steps along two neighbour vectors of the picture; `identify.py` says which dots they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cell.geometry.camera import Array

Places = NDArray[np.intp]

TOLERANCE = 0.27
SIZE_RATIO = 1.7


@dataclass(frozen=True, eq=False)
class Blobs:
    """Elliptic blobs: centres (n, 2) in px and shape matrices (n, 2, 2) that map the unit circle to the ellipse."""

    centres: Array
    shapes: Array

    @property
    def areas(self) -> Array:
        """Areas (n,) of the ellipses in px²."""
        return np.asarray(np.pi * np.abs(np.linalg.det(self.shapes)), dtype=np.float64)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Blobs:
        """The blobs of an index or a mask."""
        return Blobs(self.centres[index], self.shapes[index])


def grow_lattice(blobs: Blobs, least: int) -> tuple[NDArray[np.intp], Places] | None:
    """Indices (m,) of blobs that form a lattice and their places (m, 2); None when there is none of `least` dots.

    Right-handed as the picture is: the second step lies clockwise of the first, as y does of x.
    """
    n = len(blobs.centres)
    if n < least:
        return None
    tree = cKDTree(blobs.centres)
    distances, neighbours = tree.query(blobs.centres, k=min(n, 9))
    near, who = np.asarray(distances), np.asarray(neighbours)
    # Seeds: dots whose neighbours are about as big as they are, the most regular surroundings first.
    areas = blobs.areas
    similar = np.mean(np.abs(np.log(areas[who] / areas[:, None])) < np.log(SIZE_RATIO), axis=1)
    order = np.lexsort((near[:, -1], -similar))
    best: tuple[NDArray[np.intp], Places] | None = None
    for seed in order[:12]:
        basis = _basis(blobs.centres, areas, int(seed), who[seed][1:])
        if basis is None:
            continue
        found = _grow(blobs.centres, areas, tree, int(seed), basis)
        if best is None or len(found) > len(best[0]):
            index = np.array(list(found.values()))
            best = index, np.array(list(found))
        if len(best[0]) > 0.8 * n:
            break
    return best if best is not None and len(best[0]) >= least else None


def _basis(centres: Array, areas: Array, seed: int, neighbours: NDArray[np.intp]) -> tuple[Array, Array] | None:
    """Two shortest steps from the seed to similar neighbours that are not nearly parallel."""
    steps = [centres[k] - centres[seed] for k in neighbours if _similar(areas, seed, int(k))]
    if len(steps) < 2:
        return None
    first = steps[0]
    for second in steps[1:]:
        cross = first[0] * second[1] - first[1] * second[0]
        if abs(cross) > 0.35 * np.linalg.norm(first) * np.linalg.norm(second):
            return (first, second) if cross > 0 else (first, -second)
    return None


def _similar(areas: Array, a: int, b: int) -> bool:
    return bool(1 / SIZE_RATIO < areas[a] / areas[b] < SIZE_RATIO)


def _grow(
    centres: Array, areas: Array, tree: cKDTree, seed: int, basis: tuple[Array, Array]
) -> dict[tuple[int, int], int]:
    """Place → blob, from the seed outwards; each dot hands its own local steps to its neighbours."""
    found = {(0, 0): seed}
    steps = {seed: [basis[0], basis[1]]}
    taken = {seed}
    queue = [(0, 0)]
    while queue:
        place = queue.pop(0)
        here = found[place]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            there = (place[0] + sign, place[1]) if axis == 0 else (place[0], place[1] + sign)
            if there in found:
                continue
            step = steps[here][axis]
            across = steps[here][1 - axis]
            guess = centres[here] + sign * step
            reach = TOLERANCE * min(np.linalg.norm(step), np.linalg.norm(across))
            distance, blob = tree.query(guess)
            if distance > reach or int(blob) in taken or not _similar(areas, here, int(blob)):
                continue
            measured = sign * (centres[blob] - centres[here])
            local = list(steps[here])
            local[axis] = measured
            found[there] = int(blob)
            steps[int(blob)] = local
            taken.add(int(blob))
            queue.append(there)
    return found

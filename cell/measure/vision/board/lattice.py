"""Order among found dots or corners: grows a lattice from neighbour to neighbour, so that perspective does not matter.

Lattice places are whole steps along two neighbour vectors of the picture; `identify.py` says which points.

The map from a board's lattice to the picture: a homography, and what the lens adds near known points."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.pictures import PictureRefused, Reason

Places = NDArray[np.intp]

TOLERANCE = 0.27
SIZE_RATIO = 1.7
SEEDS = 12
WAYS = ((0, 1), (0, -1), (1, 1), (1, -1))
"""Neighbours: axis and sign."""


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


def dot_lattices(blobs: Blobs, least: int) -> Iterator[tuple[NDArray[np.intp], Places]]:
    """Lattices of at least `least` blobs, none sharing a blob: indices (m,) and places (m, 2).

    Right-handed as the picture is: the second step lies clockwise of the first, as y does of x.
    """
    n = len(blobs.centres)
    if n < least:
        return
    tree = scipy.spatial.cKDTree(blobs.centres)
    distances, neighbours = tree.query(blobs.centres, k=min(n, 9))
    near, who = np.asarray(distances), np.asarray(neighbours)
    # Seeds: dots whose neighbours are about as big as they are, the most regular surroundings first.
    areas = blobs.areas
    similar = np.mean(np.abs(np.log(areas[who] / areas[:, None])) < np.log(SIZE_RATIO), axis=1)
    order = np.lexsort((near[:, -1] / np.maximum(near[:, 1], 1e-9), -np.round(4 * similar)))
    free = np.ones(n, dtype=np.bool_)

    def alike(a: int, b: int) -> bool:
        return bool(free[b]) and bool(1 / SIZE_RATIO < areas[a] / areas[b] < SIZE_RATIO)

    tries = 0
    for seed in order:
        if not free[seed] or tries >= SEEDS:
            continue
        basis = _basis(blobs.centres, int(seed), [int(k) for k in who[seed][1:] if alike(int(seed), int(k))])
        if basis is None:
            continue
        tries += 1
        found = grow(blobs.centres, tree, int(seed), basis, alike)
        if len(found) >= least:
            index = np.array(list(found.values()), dtype=np.intp)
            free[index] = False
            yield index, np.array(list(found), dtype=np.intp)


def _basis(centres: Array, seed: int, neighbours: list[int]) -> tuple[Array, Array] | None:
    """Two shortest steps from the seed to similar neighbours that are not nearly parallel."""
    steps = [centres[k] - centres[seed] for k in neighbours]
    if len(steps) < 2:
        return None
    first = steps[0]
    for second in steps[1:]:
        cross = first[0] * second[1] - first[1] * second[0]
        if abs(cross) > 0.35 * np.linalg.norm(first) * np.linalg.norm(second):
            return (first, second) if cross > 0 else (first, -second)
    return None


def grow(
    centres: Array,
    tree: scipy.spatial.cKDTree,
    seed: int,
    basis: tuple[Array, Array],
    alike: Callable[[int, int], bool],
) -> dict[tuple[int, int], int]:
    """Place → point, from the seed outwards; each hands its own local steps to its neighbours.

    `alike(a, b)` says whether b can be a neighbour of a.
    """
    found = {(0, 0): seed}
    points: list[tuple[float, float]] = centres.tolist()
    steps = {seed: [(float(basis[0][0]), float(basis[0][1])), (float(basis[1][0]), float(basis[1][1]))]}
    queue = [(0, 0)]
    while queue:
        place = queue.pop(0)
        here = found[place]
        (x, y), own = points[here], steps[here]
        ways = [
            (axis, sign) for axis, sign in WAYS if (place[0] + sign * (not axis), place[1] + sign * axis) not in found
        ]
        if not ways:
            continue
        reach = TOLERANCE * min(math.hypot(*own[0]), math.hypot(*own[1]))
        guesses = np.array([(x + sign * own[axis][0], y + sign * own[axis][1]) for axis, sign in ways])
        near = [np.asarray(part).tolist() for part in tree.query(guesses)]
        for (axis, sign), distance, blob in zip(ways, *near, strict=True):
            if distance > reach or blob in steps or not alike(here, blob):
                continue
            there = points[blob]
            local = list(own)
            local[axis] = sign * (there[0] - x), sign * (there[1] - y)
            steps[blob] = local
            beside = (place[0] + sign * (not axis), place[1] + sign * axis)
            found[beside] = blob
            queue.append(beside)
    return found


NEAREST = 4


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """`homography` (3, 3) from lattice places to px, and the places (n, 2) with their residuals (n, 2) in px."""

    homography: Array
    places: Array
    residuals: Array

    @classmethod
    def fit(cls, places: Array | NDArray[np.intp], pixels: Array, tolerance: float, what: str) -> PlaneMap:
        """Robust fit to places (n, 2) and pixels (n, 2); `tolerance` in px. Raises PictureRefused."""
        homography, used = cv2.findHomography(places.astype(np.float64), pixels, cv2.RANSAC, tolerance)
        if homography is None or used is None or used.sum() < 4:
            raise PictureRefused(Reason.NO_BOARD, f"the points found do not lie in a plane like those of {what}")
        keep = used.ravel() > 0
        plain = cls(np.asarray(homography, dtype=np.float64), np.zeros((0, 2)), np.zeros((0, 2)))
        kept = places[keep].astype(np.float64)
        return cls(plain.homography, kept, pixels[keep] - plain.pixels(kept))

    @cached_property
    def _near(self) -> scipy.spatial.cKDTree:
        return scipy.spatial.cKDTree(self.places)

    def pixels(self, places: Array | NDArray[np.intp]) -> Array:
        """Pixels (m, 2) of lattice places (m, 2)."""
        mapped = np.column_stack([places, np.ones(len(places))]) @ self.homography.T
        pixels = mapped[:, :2] / mapped[:, 2:]
        if len(self.places) >= NEAREST:
            distance, who = self._near.query(places, k=NEAREST)
            weight = 1.0 / (np.asarray(distance) + 0.1)
            weight /= weight.sum(axis=1, keepdims=True)
            pixels = pixels + np.einsum("mk,mkd->md", weight, self.residuals[np.asarray(who)])
        return np.asarray(pixels, dtype=np.float64)

    def steps(self, places: Array) -> Array:
        """∂pixel/∂place (m, 2, 2)."""
        mapped = np.column_stack([places, np.ones(len(places))]) @ self.homography.T
        pixels = mapped[:, :2] / mapped[:, 2:]
        h = self.homography
        by_place = (h[None, :2, :2] - pixels[:, :, None] * h[None, 2:, :2]) / mapped[:, 2, None, None]
        return np.asarray(by_place, dtype=np.float64)

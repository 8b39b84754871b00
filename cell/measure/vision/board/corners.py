"""Chessboard corners in a picture: saddles of the grey values at one scale, and the lattice that they form.

What is searched is the crossing itself, so that a part of a board is enough, and shadows do not matter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.lattice import Places, grow
from cell.measure.vision.pictures import Image

SAMPLES = 32
RADII = (4.5, 7.0)
MOST = 1200
LEAST_ANTIPODAL = 0.55
LEAST_SECOND = 0.5
LEAST_CONTRAST_DN = 5.0
SEEDS = 40


@dataclass(frozen=True, eq=False)
class Corners:
    """Crossings of two edges: `places` (n, 2) in px and `dark` (n,), the direction in rad of a dark sector's middle."""

    places: Array
    dark: Array


def find_corners(image: Image, scale: float) -> Corners:
    """Saddles of an 8-bit image (h, w), looked for in the picture shrunk to `scale`."""
    small = image
    if scale < 1.0:
        small = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    smooth = np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.4), dtype=np.float32)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3, scale=0.25)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3, scale=0.25)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    saddle = xy * xy - xx * yy
    top = cv2.dilate(saddle, np.ones((7, 7), np.uint8))
    rows, columns = np.nonzero((saddle == top) & (saddle > 0.05))
    inside = (rows > 8) & (columns > 8) & (rows < saddle.shape[0] - 9) & (columns < saddle.shape[1] - 9)
    rows, columns = rows[inside], columns[inside]
    strongest = np.argsort(-saddle[rows, columns])[:MOST]
    rows, columns = rows[strongest], columns[strongest]
    # Newton's step to where the gradient vanishes.
    gx, gy = (cv2.Sobel(smooth, cv2.CV_32F, a, b, ksize=3, scale=0.125)[rows, columns] for a, b in ((1, 0), (0, 1)))
    determinant = np.minimum(-saddle[rows, columns], -1e-6)
    a, b, c = xx[rows, columns], xy[rows, columns], yy[rows, columns]
    move = np.column_stack([-(c * gx - b * gy) / determinant, -(a * gy - b * gx) / determinant])
    places = np.column_stack([columns, rows]) + np.clip(move, -1.5, 1.5)
    crossing, dark = _crossings(smooth, places)
    return Corners((places[crossing] + 0.5) / scale - 0.5, dark[crossing])


def _crossings(smooth: NDArray[np.float32], places: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which places (n, 2) look alike when turned by half a turn and change their sign four times around (n,)."""
    angles = np.arange(SAMPLES) * 2 * np.pi / SAMPLES
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    good = np.zeros(len(places), dtype=np.bool_)
    dark = np.zeros(len(places))
    if not len(places):
        return good, dark
    for radius in RADII:
        at = (places[:, None, :] + radius * unit).astype(np.float32)
        ring = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        ring = ring.reshape(len(places), SAMPLES).astype(np.float64)
        span = np.ptp(ring, axis=1)
        # The middle between bright and dark, not the mean: sectors seen obliquely are not equally wide.
        level = ring - 0.5 * (ring.max(axis=1) + ring.min(axis=1))[:, None]
        power = (level**2).sum(axis=1) + 1e-9
        antipodal = (level * np.roll(level, SAMPLES // 2, axis=1)).sum(axis=1) / power
        turns = (np.sign(level) != np.sign(np.roll(level, 1, axis=1))).sum(axis=1)
        second = (level - level.mean(axis=1)[:, None]) @ np.exp(2j * angles)
        share = 2 * np.abs(second) ** 2 / SAMPLES / ((level - level.mean(axis=1)[:, None]) ** 2).sum(axis=1).clip(1e-9)
        new = (antipodal > LEAST_ANTIPODAL) & (turns == 4) & (share > LEAST_SECOND) & (span > LEAST_CONTRAST_DN) & ~good
        dark[new] = 0.5 * np.angle(second[new]) + np.pi / 2
        good |= new
    return good, dark


def corner_lattices(corners: Corners, least: int) -> Iterator[tuple[NDArray[np.intp], Places]]:
    """Lattices of at least `least` corners, none sharing a corner: indices (m,) and places (m, 2).

    Neighbours have their dark sectors at right angles to each other. Places are right-handed as the picture is.
    """
    n = len(corners.places)
    if n < least:
        return
    free = np.ones(n, dtype=np.bool_)
    tree = scipy.spatial.cKDTree(corners.places)
    near, neighbours = tree.query(corners.places, k=min(n, 13))
    distances, who = np.asarray(near), np.asarray(neighbours)

    dark: list[float] = corners.dark.tolist()

    def opposite(a: int, b: int) -> bool:
        return bool(free[b]) and abs(math.sin(dark[a] - dark[b])) > 0.7

    tries = 0
    # Regular surroundings first: the corners whose fourth neighbour is not much farther than the first.
    order = np.argsort(distances[:, min(4, who.shape[1] - 1)] / np.maximum(distances[:, 1], 1e-9))
    for seed in order:
        if not free[seed] or tries >= SEEDS:
            continue
        basis = _basis(corners.places, int(seed), [int(k) for k in who[seed][1:] if opposite(int(seed), int(k))])
        if basis is None:
            continue
        tries += 1
        found = grow(corners.places, tree, int(seed), basis, opposite)
        if len(found) >= least:
            index = np.array(list(found.values()), dtype=np.intp)
            free[index] = False
            yield index, np.array(list(found), dtype=np.intp)


def _basis(places: Array, seed: int, neighbours: list[int]) -> tuple[Array, Array] | None:
    """Steps to the nearest neighbour that has a counterpart on the other side, and to the next one across it."""
    steps = [places[k] - places[seed] for k in neighbours]
    for k, first in enumerate(steps[:4]):
        for second in steps[k + 1 :]:
            cross = first[0] * second[1] - first[1] * second[0]
            if abs(cross) > 0.3 * np.linalg.norm(first) * np.linalg.norm(second):
                return (first, second) if cross > 0 else (first, -second)
    return None

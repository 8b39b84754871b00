"""How many columns and rows a board of markers has by the markers that were read in a picture of it.

Each count of columns puts the markers' numbers to other places; the right one puts them where they are seen.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.geometry.camera import Array
from cell.vision.board.spec import BoardSpec

MOST_COLUMNS = 30
LEAST_FIT, FIT_SHARE = 6, 0.8
"""So many markers, and this share of all, have to lie as on the board that is proposed."""
NEAR = 0.25
"""… to this share of their side."""


def propose_counts(spec: BoardSpec, corners: Array, ids: NDArray[np.intp]) -> str:
    """A sentence with the counts that markers with corners (n, 4, 2) in px and ids (n,) have; empty where unknown."""
    if len(ids) < LEAST_FIT:
        return ""
    pixels = corners.mean(axis=1)
    side = float(np.median(np.linalg.norm(np.diff(corners, axis=1), axis=2)))
    found: list[tuple[int, int, int]] = []
    for cols in range(2, MOST_COLUMNS):
        for places in _places(spec, cols, int(ids.max()) + 1):
            at = places[ids].astype(np.float64)
            homography, inliers = cv2.findHomography(at, pixels, cv2.RANSAC, max(1.0, NEAR * side))
            if homography is not None:
                found.append((int(inliers.sum()), cols, int(places[:, 1].max()) + 1))
    fit, cols, rows = max(found, default=(0, 0, 0), key=lambda f: f[0])
    if fit < max(LEAST_FIT, FIT_SHARE * len(ids)):
        return ""
    return f" By the markers read it has {cols}x{rows}: name those counts (more rows where the last are not in view)"


def _places(spec: BoardSpec, cols: int, count: int) -> list[NDArray[np.intp]]:
    """Column and row (count, 2) of each marker: all fields of a grid of tags, the white ones of a ChArUco board."""
    number = np.arange(2 * count + 2 * cols)
    row, column = np.divmod(number, cols)
    every = np.column_stack([column, row])
    if spec.kind == "aprilgrid":
        return [every[:count]]
    return [every[(column + row) % 2 == parity][:count] for parity in (1, 0)]

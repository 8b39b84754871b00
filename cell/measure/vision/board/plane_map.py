"""The map from a board's lattice to the picture: a homography, and what the lens adds near known points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.pictures import PictureRefused, Reason

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

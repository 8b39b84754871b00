"""What neighbouring points of a scan are off by together: the drawing's facets, the part's form, a stripe on a slope.

A point's own noise averages out over thousands of them. What a patch of the surface shares does not, and a motion that
one patch tells is known no better than that patch. How much it is, the patches' own mean distances show.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cell.measure.inversion.closest import Array
from cell.measure.inversion.correspondences import SIGMA_FLOOR
from cell.measure.inversion.registration import Registration

PATCH_M = 0.004
LEAST_POINTS = 8
"""Of a patch whose mean distance counts."""
FAR = 3.5
"""Robust deviations beyond which a patch is a foreign body, not one of many."""


def shared_by_patches(found: Registration) -> tuple[float, Array]:
    """One standard deviation, m, of what a patch's points share, and the pose's covariance (6, 6) because of it."""
    patch, count = _patches(found)
    weights = 1.0 / found.sigmas**2
    total = np.bincount(patch, weights)
    means, by_noise = np.bincount(patch, weights * found.heights) / total, 1.0 / total
    many = count >= LEAST_POINTS
    sigma = _beyond_noise(means[many], by_noise[many])
    follow = np.stack([np.bincount(patch, along) for along in found.follow])
    return sigma, np.asarray(sigma**2 * follow @ follow.T)


def _beyond_noise(means: Array, by_noise: Array) -> float:
    """What patches with these mean distances, m, deviate by beyond the variances, m², of their points' noise."""
    if not len(means):
        return SIGMA_FLOOR
    near = np.abs(means) <= FAR * 1.4826 * np.median(np.abs(means))
    return float(np.sqrt(max(SIGMA_FLOOR**2, np.mean(means[near] ** 2 - by_noise[near]))))


def _patches(found: Registration) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The patch of each accepted point, and how many points each has: a square across the way that the surface faces.

    Not by how high the points lie: a border along the surface would part them by the sign of their noise.
    """
    turn = found.base_from_surface.rotation
    square = np.floor(found.arms @ turn / PATCH_M).astype(np.intp)
    normals = found.normals @ turn
    axis = np.argmax(np.abs(normals), axis=1)[:, None]
    np.put_along_axis(square, axis, 0, axis=1)
    faces = 2 * axis + (np.take_along_axis(normals, axis, axis=1) > 0)
    _, patch, count = np.unique(np.hstack([square, faces]), axis=0, return_inverse=True, return_counts=True)
    return patch.reshape(-1), count

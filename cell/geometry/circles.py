"""Where the middle of a printed dot is seen: the centre of its ellipse, which is not the image of its centre.

For a dot of 1.2 mm radius at 130 mm the difference is .05 px at 20° and .07 px at 40° (docs/theory.md, section 6).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cell.geometry.camera import Array, CameraModel

STEP = 1e-4
_STEPS = STEP * np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.0, 0.0)])
"""To either side along x and y, and none."""


def seen_centres(centres: ArrayLike, normal: ArrayLike, radius: float) -> Array:
    """Points (n, 3) whose images are the centres of the ellipses of circles with `centres` (n, 3), all in m.

    The circles lie in planes with the unit `normal` (3,); everything is in the camera frame. The image of a circle
    has the dual conic c cᵀ − r²(I − n nᵀ); its last column is the ellipse's centre in homogeneous coordinates.
    """
    c = np.atleast_2d(np.asarray(centres, dtype=np.float64))
    n = np.asarray(normal, dtype=np.float64)
    seen = c * c[:, 2:3] + radius**2 * n * n[2]
    seen[:, 2] -= radius**2
    return np.asarray(seen / c[:, 2:3], dtype=np.float64)


def seen_centres_with_jacobians(centres: ArrayLike, normal: ArrayLike, radius: float) -> tuple[Array, Array, Array]:
    """`seen_centres` (n, 3) with their derivatives by the centres and by the normal, both (n, 3, 3)."""
    c = np.atleast_2d(np.asarray(centres, dtype=np.float64))
    n = np.asarray(normal, dtype=np.float64)
    share = radius**2 / c[:, 2]
    aside = n * n[2] - np.array([0.0, 0.0, 1.0])
    by_centre = np.tile(np.eye(3), (len(c), 1, 1))
    by_centre[:, :, 2] -= (share / c[:, 2])[:, None] * aside
    by_normal = n[2] * np.eye(3)
    by_normal[:, 2] += n
    return c + share[:, None] * aside, by_centre, share[:, None, None] * by_normal


def lens_shift(camera: CameraModel, centres: ArrayLike, normal: ArrayLike, radius: float) -> Array:
    """What the lens adds in px (n, 2) to the seen centres of circles with `centres` (n, 3), arguments as above.

    Distortion bends an ellipse: the middle of its area moves by ½ tr(H C) + J C ∇ln|J|, with the distortion's Jacobian
    J and second derivatives H, and the second moments C of the undistorted ellipse. A dot of 30 px radius seen with
    k1 = −.2 is moved by .01 px, in one direction all over the picture's rim, which is felt in the board's distance.
    """
    c = np.atleast_2d(np.asarray(centres, dtype=np.float64))
    n = np.asarray(normal, dtype=np.float64)
    xy = c[:, :2] / c[:, 2:]
    to_plane = np.zeros((len(c), 2, 3))
    to_plane[:, 0, 0] = to_plane[:, 1, 1] = 1.0 / c[:, 2]
    to_plane[:, :, 2] = -xy / c[:, 2:]
    moments = 0.25 * radius**2 * to_plane @ (np.eye(3) - np.outer(n, n)) @ to_plane.transpose(0, 2, 1)

    # All in one call: it takes as long for few points as for many.
    about = xy + _STEPS[:, None, None] + _STEPS[:4, None]
    right, left, down, up = camera.distort(about.reshape(-1, 2)).reshape(about.shape).swapaxes(0, 1)
    jacobians = np.stack([right - left, down - up], axis=3) / (2 * STEP)
    along, across = ((jacobians[k] - jacobians[k + 1]) / (2 * STEP) for k in (0, 2))
    middle = jacobians[4]
    second = np.stack([along, across], axis=3)
    inverse = np.linalg.inv(middle)
    slope = np.column_stack([np.trace(inverse @ d, axis1=1, axis2=2) for d in (along, across)])
    bent = 0.5 * np.einsum("nkij,nij->nk", second, moments) + np.einsum("nki,nij,nj->nk", middle, moments, slope)
    return np.asarray(bent * (camera.fx, camera.fy), dtype=np.float64)

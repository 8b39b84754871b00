"""Where the middle of a printed dot is seen: the centre of its ellipse, which is not the image of its centre.

For a dot of 1.2 mm radius at 130 mm the difference is .05 px at 20° and .07 px at 40° (docs/theory.md, section 6).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cell.geometry.camera import Array, CameraModel


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
    by_centre = np.empty((len(c), 3, 3))
    by_centre[:] = np.eye(3)
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
    x, y = c[:, 0] / c[:, 2], c[:, 1] / c[:, 2]
    nx, ny, nz = np.asarray(normal, dtype=np.float64)
    across, along = nx - x * nz, ny - y * nz
    size = 0.25 * (radius / c[:, 2]) ** 2
    cxx, cxy, cyy = size * (1 + x * x - across**2), size * (x * y - across * along), size * (1 + y * y - along**2)

    k1, k2, p1, p2, k3 = camera.dist
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    bend = 4 * (2 * k2 + 6 * k3 * r2)
    # Radial and tangential terms are the gradient of one function: all these derivatives are symmetric.
    jxx, jxy = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, x * y * slope + 2 * p1 * x + 2 * p2 * y
    jyy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    hxxx, hxxy = 3 * x * slope + x**3 * bend + 6 * p2, y * slope + x * x * y * bend + 2 * p1
    hxyy, hyyy = x * slope + x * y * y * bend + 2 * p2, 3 * y * slope + y**3 * bend + 6 * p1
    area = jxx * jyy - jxy * jxy
    gx, gy = (hxxx * jyy + jxx * hxyy - 2 * jxy * hxxy) / area, (hxxy * jyy + jxx * hyyy - 2 * jxy * hxyy) / area
    tx, ty = cxx * gx + cxy * gy, cxy * gx + cyy * gy
    return np.column_stack(
        [
            camera.fx * (0.5 * (hxxx * cxx + hxyy * cyy) + hxxy * cxy + jxx * tx + jxy * ty),
            camera.fy * (0.5 * (hxxy * cxx + hyyy * cyy) + hxyy * cxy + jxy * tx + jyy * ty),
        ]
    )

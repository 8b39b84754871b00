"""Where the middle of a printed dot is seen: the centre of its ellipse, which is not the image of its centre.

For a dot of 1.2 mm radius at 130 mm the difference is .05 px at 20° and .07 px at 40° (docs/explanation/theory.md,
section 6).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cell.measure.geometry.camera import Array


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

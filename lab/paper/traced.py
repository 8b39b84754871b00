"""The truth that the paper's equations are held against: rays met with planes by solving for their crossing.

Plain vectors only; nothing of the estimators' camera or light plane is used, so that errors cannot cancel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def light_point(x: ArrayLike, y: ArrayLike, baseline: float, focal: float, theta: float) -> Array:
    """Points (n, 3) in m where the rays through sensor points x', y' (n,) in m meet the laser's fan.

    Camera at the origin looking along +z, upright image. The laser stands at (−baseline, 0, 0); its fan is spanned by
    the ray at the angle θ to the baseline and by the y axis. Each crossing solves t·ray = laser + a·middle + b·side.
    """
    xs, ys = np.atleast_1d(np.asarray(x, dtype=np.float64)), np.atleast_1d(np.asarray(y, dtype=np.float64))
    laser = np.array([-baseline, 0.0, 0.0])
    middle = np.array([np.cos(theta), 0.0, np.sin(theta)])
    side = np.array([0.0, 1.0, 0.0])
    rays = np.column_stack([xs, ys, np.full(len(xs), focal)])
    systems = np.stack([rays, np.tile(-middle, (len(xs), 1)), np.tile(-side, (len(xs), 1))], axis=2)
    shares = np.linalg.solve(systems, np.tile(laser, (len(xs), 1))[:, :, None])[:, 0]
    return np.asarray(rays * shares, dtype=np.float64)


def oblique_image(
    height: ArrayLike, theta_1: float, theta_2: float, distance: float, principal: float, tilt: float
) -> Array:
    """Image coordinate x' (n,) in m of a spot at `height` (n,) m above the reference plane, beam and camera oblique.

    Beam and optical axis cross on the reference plane, at θ1 and θ2 on either side of its normal. The lens stands
    `distance` m from the crossing (the paper's L1), the detector's middle `principal` m behind it (L2), turned by
    `tilt` from the perpendicular of the axis, so that its side for higher spots is farther from the lens for tilt > 0.
    """
    h = np.atleast_1d(np.asarray(height, dtype=np.float64))
    beam = np.array([-np.sin(theta_1), np.cos(theta_1)])
    axis = np.array([np.sin(theta_2), np.cos(theta_2)])
    across = np.array([axis[1], -axis[0]])
    lens = distance * axis
    middle = lens + principal * axis
    along = np.cos(tilt) * across + np.sin(tilt) * axis
    found = np.empty(len(h))
    for k, value in enumerate(h):
        spot = value / np.cos(theta_1) * beam
        # spot + t (lens − spot) = middle + x' along
        found[k] = np.linalg.solve(np.column_stack([lens - spot, -along]), middle - spot)[1]
    return found

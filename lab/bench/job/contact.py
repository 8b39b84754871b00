"""What contact makes of the errors of placing: the part comes down until it touches, and rests there.

Whatever height it was brought to, it ends on the highest point of the ground under it, so that its error along the way
down is not what the cell's errors are but what tilt and slope leave of them. The other five are as they were.
"""

from __future__ import annotations

import numpy as np

from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface, PlacePose
from cell.procedures.part_error import part_points
from drivers.interfaces import Vector
from lab.bench.job.scan_errors import by_pose

DRAWS = 1000
UNDERSIDE = 400
"""So many points of the underside are looked at for the first contact."""


def mean_after_contact(placing: Vector, nominal: NominalSurface, pose: PlacePose) -> float:
    """Mean distance in m of the part's 45 points from where they belong, once it rests.

    `placing` (6, 6) is the covariance of the part's place in the air, base axes, about the surface's origin; down is
    the base's -z.
    """
    values, vectors = np.linalg.eigh(placing)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    steps = np.random.default_rng(0).standard_normal((DRAWS, 6)) @ root.T
    every = max(1, len(nominal.samples) // UNDERSIDE)
    surface = pose.base_from_surface
    under = transform(surface, nominal.samples[::every]) - surface.translation
    normals = nominal.normals[nominal.sample_triangles[::every]] @ surface.rotation.T
    # How far the underside lies over the ground, straight down, where it is displaced by d: n·d / n_z.
    above = (steps @ by_pose(under).transpose(0, 2, 1)).transpose(1, 0, 2)
    gaps = np.einsum("kni,ni->kn", above, normals / normals[:, 2:])
    drop = gaps.min(axis=1)
    points = transform(surface, part_points(nominal)) - surface.translation
    ended = (steps @ by_pose(points).transpose(0, 2, 1)).transpose(1, 0, 2)
    ended[:, :, 2] -= drop[:, None]
    return float(np.linalg.norm(ended, axis=2).mean())

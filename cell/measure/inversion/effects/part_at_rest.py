"""Has a placed part come to rest? Two sweeps of it are compared, and of the surface beside it.

What moves arm or vehicle moves both alike, and so does what is not known of the sweeps' times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.measure.inversion.effects.between_sweeps import (
    CREEP_EVIDENCE,
    FLOOR,
    GATE_M,
    LEAST_MATCHED,
    SurfaceMotion,
    surface_motion,
)
from cell.measure.inversion.nominal import Array, Indices, NominalSurface
from cell.measure.inversion.part_pose import parted
from cell.measure.reconstruction.cloud import Cloud

LEAST_POINTS = 500
LEAST_M = 15e-6
"""A part whose points move by less than this between two sweeps, on average, counts as at rest."""


@dataclass(frozen=True, eq=False)
class PartOnGround:
    """A part with these `faces`, about where it lies (`base_from_part`), and the `ground` beside it with
    `base_from_ground`; None for a part that lies in a nest."""

    faces: NominalSurface
    base_from_part: pin.SE3
    ground: NominalSurface | None = None
    base_from_ground: pin.SE3 | None = None

    def moved(self, first: Cloud, second: Cloud, unsure: Array) -> float | None:
        """How far, m, the part's points moved on average between two clouds, arm base; None where it lies still, or
        the first one does not show it, and `GATE_M` for one that is not near any more.

        `unsure` (6, 6), base axes, is by how much the clouds may lie apart for another reason: times, the arm. Ground
        beside the part tells it better.
        """
        (before, ground_before), (now, ground_now) = (
            parted(cloud, self.faces, self.base_from_part) for cloud in (first, second)
        )
        if before.size < LEAST_POINTS:
            return None
        part = _motion(before, now, self.faces, self.base_from_part)
        if part.matched < LEAST_MATCHED:
            return GATE_M
        motion, covariance = part.motion, part.scatter + FLOOR
        if self.ground is None or self.base_from_ground is None or ground_before.size < LEAST_POINTS:
            covariance = covariance + unsure
        else:
            ground = _motion(ground_before, ground_now, self.ground, self.base_from_ground)
            # Where the ground tells nothing, what is known beforehand stands.
            told = unsure @ np.linalg.inv(unsure + ground.scatter)
            carried = np.eye(6)
            carried[:3, 3:] = -pin.skew(self.base_from_part.translation - self.base_from_ground.translation)
            motion = motion - carried @ told @ ground.motion
            covariance = covariance + carried @ (unsure - told @ unsure) @ carried.T
        if motion @ np.linalg.solve(covariance, motion) < CREEP_EVIDENCE:
            return None
        points = self.faces.vertices @ self.base_from_part.rotation.T
        far = float(np.linalg.norm(motion[:3] + np.cross(motion[3:], points), axis=1).mean())
        return far if far > LEAST_M else None


def _motion(first: Cloud, second: Cloud, nominal: NominalSurface, pose: pin.SE3) -> SurfaceMotion:
    return surface_motion(first, second, nominal, pose, (_nothing, _nothing))


def _nothing(lines: Indices, rows: Indices) -> Array:
    """The poses move no point: what they are off by moves part and ground alike."""
    return np.zeros((len(lines), 3, 0))

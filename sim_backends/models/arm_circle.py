"""A move of the simulated arm's tool along a circle through three points. Units: rad, m, s."""

from __future__ import annotations

import math

import numpy as np

from sim_backends.models.arm_kinematics import Matrix, Vector, rotation_matrix
from sim_backends.models.arm_motion import JointDrives, LinearMove, MotionError, Trapezoid


class ArcMove(LinearMove):
    """Tool on the circle from where it stands past `via` (3,) to `target` (4, 4), turning evenly to the target's
    orientation or, when `fixed`, with the circle."""

    shape = "circle"

    def __init__(self, via: Vector, target: Matrix, speed: float, acceleration: float, fixed: bool = False) -> None:
        super().__init__(target, speed, acceleration, slows=True)
        self._via = via
        self._fixed = fixed
        self._axis: Vector | None = None

    def begin(self, drive: JointDrives) -> None:
        """Find the circle, or go on along it; MotionError when the three points lie on a line."""
        super().begin(drive)
        here = self._start[:3, 3]
        if self._axis is None:
            self._centre, self._axis = self._circle(here)
        self._first, last = here - self._centre, self._target[:3, 3] - self._centre
        sine, cosine = float(self._axis.dot(np.cross(self._first, last))), float(self._first.dot(last))
        self._angle = math.atan2(sine, cosine) % (2.0 * math.pi)
        # A stop in between may have left the circle a little.
        self._off = last - rotation_matrix(self._axis * self._angle).dot(self._first)
        turn = 0.0 if self._fixed else math.hypot(*self._turn)
        self._profile = Trapezoid(max(self._angle * math.hypot(*self._first), turn), self._speed, self._acceleration)

    def _circle(self, here: Vector) -> tuple[Vector, Vector]:
        """Its centre (3,) and the axis (3,) that it is gone round."""
        past, whole = self._via - here, self._way
        normal = np.cross(past, whole)
        size = float(normal.dot(normal))
        if size < 1e-9 * float(past.dot(past)) * float(whole.dot(whole)) or size == 0.0:
            raise MotionError("the start, the via point and the end of a circle lie on a line")
        arm = whole.dot(whole) * np.cross(normal, past) + past.dot(past) * np.cross(whole, normal)
        return here + arm / (2.0 * size), normal / math.sqrt(size)

    def _pose(self, fraction: float) -> Matrix:
        assert self._axis is not None
        pose = np.eye(4)
        along = rotation_matrix(self._axis * (self._angle * fraction))
        turn = along if self._fixed else rotation_matrix(self._turn * fraction)
        pose[:3, :3] = turn.dot(self._start[:3, :3])
        pose[:3, 3] = self._centre + along.dot(self._first) + fraction * self._off
        return pose

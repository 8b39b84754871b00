"""How fast the flange and what it carries may be: the arm's tool speed as a bound on every point of them.

Of a rigid body the fastest point is always one of its corners, since a point's speed is a convex function of where the
point is: the flange's origin and the corners of all boxes that hang on the flange are enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from cell.motion.bodies import FLANGE, Body
from cell.motion.kinematics import ArmKinematics, Joints

STEP = 0.02
"""Largest joint step in rad between two looks at a path."""
MARGIN = 1.001
"""What the speed between two looks may exceed that at them by; 5e-5 is the most seen over 600 random moves."""


class PointSpeed:
    """A bound `limit` in m/s on the speed of `points` (n, 3), m in the flange frame."""

    def __init__(self, kinematics: ArmKinematics, points: NDArray[np.float64], limit: float) -> None:
        self._kinematics = kinematics
        self._points = points
        self._limit = limit

    def fraction_speed(self, start: Joints, end: Joints) -> float:
        """How fast the straight joint way from `start` to `end` (6,) may be driven at most, in ways per second."""
        way = end - start
        count = int(np.ceil(np.abs(way).max() / STEP)) + 1
        fastest = max(self._fastest(start + part * way, way) for part in np.linspace(0.0, 1.0, count + 1))
        return self._limit / max(MARGIN * fastest, 1e-12)

    def excess(self, times: NDArray[np.float64], joints: NDArray[np.float64]) -> float:
        """Speed of the fastest point along the samples (n,) s and (n, 6) rad of a motion, over the limit."""
        placed = np.array([self._placed(row) for row in joints])
        ways = np.linalg.norm(np.diff(placed, axis=0), axis=2).max(axis=1)
        return float((ways / np.diff(times)).max() / self._limit)

    def _fastest(self, joints: Joints, rates: Joints) -> float:
        """Speed of the fastest point, m/s, when the joints turn at `rates` (6,) rad/s."""
        twist = self._kinematics.jacobian(joints) @ rates
        speeds = twist[:3] + np.cross(twist[3:], self._points)
        return float(np.sqrt(np.max(np.sum(speeds**2, axis=1))))

    def _placed(self, joints: Joints) -> NDArray[np.float64]:
        flange = self._kinematics.fk(joints)
        placed: NDArray[np.float64] = self._points @ flange.rotation.T + flange.translation
        return placed


def carried_points(bodies: Sequence[Body]) -> NDArray[np.float64]:
    """The flange's origin and the corners of every body on the flange, (n, 3) m in the flange frame."""
    points = [np.zeros(3)]
    for body in bodies:
        if body.parent == FLANGE:
            half = 0.5 * np.array(body.size) + (body.radius or 0.0)
            points += [body.placement.act(np.array(signs) * half) for signs in product((-1.0, 1.0), repeat=3)]
    return np.array(points)

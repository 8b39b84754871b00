"""Collision-free motions: a direct joint move, else one over corners that a search finds.

Everything is deterministic: the same question gives the same path. Every motion is checked all along, between its
samples as well, before it is returned. Moves are joined at rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.motion.clearance import first_touch
from cell.motion.collision import CollisionError, CollisionModel, Pair
from cell.motion.kinematics import ArmKinematics, JointLimits, Joints
from cell.motion.path_search import Effort, limits, search
from cell.motion.point_speed import PointSpeed, carried_points
from cell.motion.trajectory import LineLimits, Trajectory, join, plan_joint, plan_line

EFFORTS = (
    Effort(1, 1.2, 0.05, 8000),
    Effort(2, 2.4, 0.05, 12000),
    Effort(3, 7.0, 0.05, 12000),
    Effort(4, 1.2, 0.02, 12000),
    Effort(5, 7.0, 0.02, 16000),
)
"""The searches, one after the other until a way is found that stays free between its steps."""


class Planner:
    """Plans motions of one arm among one set of bodies. One instance per thread.

    `tool_speed` in m/s binds every point of the flange and of what it carries, in free moves and in lines.
    """

    def __init__(
        self,
        kinematics: ArmKinematics,
        collisions: CollisionModel,
        limits: JointLimits | None = None,
        tool_speed: float | None = None,
    ) -> None:
        self.kinematics = kinematics
        carried = carried_points(collisions.bodies)
        self._points = None if tool_speed is None else PointSpeed(kinematics, carried, tool_speed)
        self.collisions = collisions
        self.limits = limits or kinematics.limits

    def reach(self, base_from_flange: pin.SE3, seed: Joints, what: str, allowed: Sequence[Pair] = ()) -> Joints:
        """Joint angles of a collision-free posture at the pose, the nearest to `seed`.

        Raises `kinematics.Unreachable`, or `CollisionError` with the bodies that touch in the nearest posture.
        """
        found = self.kinematics.solutions(base_from_flange, seed)
        if not found:
            self.kinematics.ik(base_from_flange, seed)
        for joints in found:
            if self.collisions.free(joints, allowed):
                return joints
        self.collisions.require_free(found[0], what, allowed)
        return found[0]

    def free(self, start: Joints, end: Joints, allowed: Sequence[Pair] = ()) -> Trajectory:
        """A collision-free joint motion from rest at `start` to rest at `end`; `CollisionError` when none is found."""
        start, end = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64)
        self.collisions.require_free(start, "where the arm stands", allowed)
        self.collisions.require_free(end, "the end of the motion", allowed)
        path = self._path(start, end, tuple(allowed))
        return join([plan_joint(a, b, self.limits, points=self._points) for a, b in itertools.pairwise(path)])

    def line(
        self, start: Joints, base_from_end: pin.SE3, limits: LineLimits | None = None, allowed: Sequence[Pair] = ()
    ) -> Trajectory:
        """A straight line of the flange to `base_from_end`, checked; see `trajectory.plan_line` for its errors."""
        motion = plan_line(self.kinematics, start, base_from_end, limits, points=self._points)
        self.require_clear(motion, "the straight line", allowed)
        return motion

    def require_clear(self, motion: Trajectory, what: str, allowed: Sequence[Pair] = ()) -> None:
        """Raise `CollisionError` when bodies touch anywhere along `motion`."""
        touch = first_touch(self.collisions, motion.joints, tuple(allowed))
        if touch is not None:
            raise self.collisions.error(f"{what} at {motion.times[touch.sample]:.2f} s", touch.pairs)

    def _path(self, start: Joints, end: Joints, allowed: tuple[Pair, ...]) -> NDArray[np.float64]:
        """Corners (n, 6) rad of a free way, straight between them."""
        direct = np.stack([start, end])
        if first_touch(self.collisions, direct, allowed) is None:
            return direct
        ranges = np.array(self.limits.lower), np.array(self.limits.upper)
        for effort in EFFORTS:
            path = search(lambda joints: self.collisions.free(joints, allowed), start, end, ranges, effort)
            if path is not None and first_touch(self.collisions, path, allowed) is None:
                return path
        raise CollisionError(
            f"no free way was found between joints {np.degrees(start).round(1).tolist()} and "
            f"{np.degrees(end).round(1).tolist()} deg{limits()}. Move the arm to a freer posture with `cell jog` first"
        )

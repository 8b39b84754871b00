"""Collision-free motions: a direct joint move, else one over via-points, else one that a small tree search finds.

Everything is deterministic: the same question gives the same path. Every motion is checked along its samples before
it is returned. Moves are joined at rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.motion.collision import CollisionError, CollisionModel, Pair
from cell.motion.kinematics import ArmKinematics, JointLimits, Joints, Unreachable
from cell.motion.point_speed import PointSpeed, carried_points
from cell.motion.trajectory import LineLimits, Trajectory, join, plan_joint, plan_line

STEPS = (0.02, 0.004)
"""Largest joint step in rad between two checks of a path; the finer one when bodies graze between the coarser steps."""
REACH = 0.6
"""Longest branch in rad that the tree search adds at once."""
NODES = 1500
"""Most nodes per tree before the search gives up."""


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

        Raises `Unreachable`, or `CollisionError` with the bodies that touch in the nearest posture.
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
        for step in STEPS:
            path = self._path(start, end, allowed, step)
            motion = join([plan_joint(a, b, self.limits, points=self._points) for a, b in itertools.pairwise(path)])
            if all(self.collisions.free(joints, allowed) for joints in motion.joints):
                return motion
        self.require_clear(motion, "the motion", allowed)
        return motion

    def line(
        self, start: Joints, base_from_end: pin.SE3, limits: LineLimits | None = None, allowed: Sequence[Pair] = ()
    ) -> Trajectory:
        """A straight line of the flange to `base_from_end`, checked; see `trajectory.plan_line` for its errors."""
        motion = plan_line(self.kinematics, start, base_from_end, limits, points=self._points)
        self.require_clear(motion, "the straight line", allowed)
        return motion

    def require_clear(self, motion: Trajectory, what: str, allowed: Sequence[Pair] = ()) -> None:
        """Raise `CollisionError` when bodies touch anywhere along the samples of `motion`."""
        for time, joints in zip(motion.times, motion.joints, strict=True):
            if not self.collisions.free(joints, allowed):
                self.collisions.require_free(joints, f"{what} at {time:.2f} s", allowed)

    def _clear(self, start: Joints, end: Joints, allowed: Sequence[Pair], step: float) -> bool:
        """True when nothing touches along the straight joint path, checked from the middle outwards."""
        count = max(2, int(np.ceil(np.abs(end - start).max() / step)) + 1)
        fractions = np.linspace(0.0, 1.0, count)
        order = np.argsort(np.abs(fractions - 0.5), kind="stable")
        return all(self.collisions.free(start + f * (end - start), allowed) for f in fractions[order])

    def _path(self, start: Joints, end: Joints, allowed: Sequence[Pair], step: float) -> list[Joints]:
        if self._clear(start, end, allowed, step):
            return [start, end]
        candidates = [[start, *via, end] for via in self._vias(start, end)]
        clear = [p for p in candidates if all(self._clear(a, b, allowed, step) for a, b in itertools.pairwise(p))]
        if clear:
            return min(clear, key=_length)
        return self._shortened(self._search(start, end, allowed, step), allowed, step)

    def _vias(self, start: Joints, end: Joints) -> list[list[Joints]]:
        """Deterministic detours: raised above the start, the end or both, and the pan turned before or after."""
        lifts = (0.1, 0.2, 0.35)
        above_start = [q for h in lifts if (q := self._raised(start, h)) is not None]
        above_end = [q for h in lifts if (q := self._raised(end, h)) is not None]
        vias = [[q] for q in above_start + above_end]
        vias += [[p, q] for p in above_start for q in above_end]
        for first, last in ((start, end), *((p, q) for p in above_start for q in above_end)):
            early, late = first.copy(), last.copy()
            early[0], late[0] = last[0], first[0]
            ends = [first] if first is not start else []
            tail = [last] if last is not end else []
            vias += [[*ends, early, *tail], [*ends, late, *tail]]
        return vias

    def _raised(self, joints: Joints, height: float) -> Joints | None:
        pose = self.kinematics.fk(joints)
        pose.translation = pose.translation + np.array([0.0, 0.0, height])
        try:
            return self.kinematics.track(pose, joints)
        except Unreachable:
            return None

    def _search(self, start: Joints, end: Joints, allowed: Sequence[Pair], step: float) -> list[Joints]:
        """RRT-connect between the two postures with a fixed seed (Kuffner and LaValle, 2000)."""
        rng = np.random.default_rng(0)
        middle, spread = (start + end) / 2, np.abs(end - start) / 2 + 1.2
        low = np.maximum(self.limits.lower, middle - spread)
        high = np.minimum(self.limits.upper, middle + spread)
        trees: list[_Tree] = [_Tree(start), _Tree(end)]
        while min(len(t.parents) for t in trees) < NODES:
            tree, other = trees
            grown = self._grow(tree, rng.uniform(low, high), allowed, step)
            if grown is not None:
                goal, met = tree.nodes[grown], self._grow(other, tree.nodes[grown], allowed, step)
                while met is not None and not np.allclose(other.nodes[met], goal, atol=1e-9):
                    met = self._grow(other, goal, allowed, step)
                if met is not None:
                    path = tree.trace(grown)[::-1] + other.trace(met)[1:]
                    return path if np.allclose(path[0], start) else path[::-1]
            trees.reverse()
        raise CollisionError(
            f"no free way was found between joints {np.degrees(start).round(1).tolist()} and "
            f"{np.degrees(end).round(1).tolist()} deg. Move the arm to a freer posture with `cell jog` first"
        )

    def _grow(self, tree: _Tree, target: Joints, allowed: Sequence[Pair], step: float) -> int | None:
        """Add a node at most `REACH` towards `target`; its index, or None when something is in the way."""
        nearest = tree.nearest(target)
        origin = tree.nodes[nearest]
        gap = target - origin
        node = origin + gap * min(1.0, REACH / max(float(np.linalg.norm(gap)), 1e-12))
        return tree.add(node, nearest) if self._clear(origin, node, allowed, step) else None

    def _shortened(self, path: list[Joints], allowed: Sequence[Pair], step: float) -> list[Joints]:
        """The path without the nodes that a free straight path can skip."""
        short, i = [path[0]], 0
        while i < len(path) - 1:
            i = next(
                j for j in range(len(path) - 1, i, -1) if j == i + 1 or self._clear(path[i], path[j], allowed, step)
            )
            short.append(path[i])
        return short


class _Tree:
    """Nodes of one search tree and the index of each node's parent."""

    def __init__(self, root: Joints) -> None:
        self.nodes: NDArray[np.float64] = np.empty((NODES + 2000, 6))
        self.nodes[0] = root
        self.parents = [-1]

    def nearest(self, target: Joints) -> int:
        return int(np.argmin(np.sum((self.nodes[: len(self.parents)] - target) ** 2, axis=1)))

    def add(self, node: Joints, parent: int) -> int:
        if len(self.parents) == len(self.nodes):
            self.nodes = np.concatenate([self.nodes, np.empty_like(self.nodes)])
        self.nodes[len(self.parents)] = node
        self.parents.append(parent)
        return len(self.parents) - 1

    def trace(self, index: int) -> list[Joints]:
        """Nodes from `index` back to the root."""
        path = []
        while index >= 0:
            path.append(self.nodes[index].copy())
            index = self.parents[index]
        return path


def _length(path: list[Joints]) -> float:
    return float(sum(np.abs(b - a).max() for a, b in itertools.pairwise(path)))

"""Which bodies of the cell touch at given joint angles.

Checks the moving bodies against what stands still and against each other; bodies that are joined to each other are
left out, and a caller may allow named pairs, such as the part and the surface in the guarded descent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from operator import attrgetter

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.motion.bodies import BASE, FLANGE, Body
from cell.motion.kinematics import ArmKinematics, Joints
from drivers.errors import RefusedError

Pair = tuple[str, str]
"""Names of two bodies."""
ROUNDING = 1e-4
"""Bodies count as touching this much in m before the margin, so that between two looks at a way the margin is kept."""


class CollisionError(RefusedError):
    """A pose or every path found would make bodies touch; the text names them."""


class CollisionModel:
    """Bodies of the arm, of what it carries and of its surroundings. One instance per thread.

    `margin` is the distance in m below which two bodies count as touching.
    """

    def __init__(self, kinematics: ArmKinematics, bodies: Sequence[Body], margin: float = 0.005) -> None:
        if not 0.0 <= margin <= 0.1:
            raise ValueError(f"collision margin {margin} m must lie in 0 … 0.1 m")
        names = [body.name for body in bodies]
        if len(set(names)) != len(names):
            raise ValueError(f"bodies need names of their own, got {sorted(names)}")
        self.bodies = tuple(bodies)
        self.margin = margin
        self._model = kinematics.model
        self._data = self._model.createData()
        self._geometry = pin.GeometryModel()
        for body in bodies:
            joint, placement = body.parent, body.placement
            if joint == FLANGE:
                joint, placement = 6, kinematics.joint6_from_flange * placement
            self._geometry.addGeometryObject(pin.GeometryObject(body.name, joint, placement, _shape(body)))
        self._pairs: list[Pair] = []
        for i, first in enumerate(bodies):
            for j in range(i + 1, len(bodies)):
                if _may_touch(first, bodies[j]):
                    self._geometry.addCollisionPair(pin.CollisionPair(i, j))
                    self._pairs.append((first.name, bodies[j].name))
        self._geometry_data = self._geometry.createData()
        for request in self._geometry_data.collisionRequests:
            request.security_margin = margin + ROUNDING
        results = self._geometry_data.distanceResults
        self._distance_results = [results[i] for i in range(len(self._pairs))]
        self.swing = self._swing()

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """The pairs of bodies that are looked at, in the order of `distances`."""
        return tuple(self._pairs)

    def distances(self, joints: Joints) -> NDArray[np.float64]:
        """(pairs,) distance in m of each pair at the joint angles (6,) rad, negative where they overlap."""
        pin.computeDistances(self._model, self._data, self._geometry, self._geometry_data, _array(joints))
        return np.fromiter(map(_least, self._distance_results), np.float64, len(self._pairs))

    def excused(self, allowed: Sequence[Pair]) -> NDArray[np.bool_]:
        """(pairs,) which of the pairs are among the `allowed` ones."""
        names = {frozenset(pair) for pair in allowed}
        return np.array([frozenset(pair) in names for pair in self._pairs], dtype=np.bool_)

    def _swing(self) -> NDArray[np.float64]:
        """(pairs, 6) by how many m a pair can come nearer, at most, when a joint between the two turns by 1 rad.

        That is how far from the joint's axis the farther body can reach: its own corners, and the links in between.
        """
        links = [float(np.linalg.norm(self._model.jointPlacements[k].translation)) for k in range(2, 7)]
        swing = np.zeros((len(self._pairs), 6))
        shapes = {body.name: body for body in self.bodies}
        objects = {shape.name: shape for shape in self._geometry.geometryObjects}
        for row, pair in zip(swing, self._pairs, strict=True):
            near, far = sorted((objects[name] for name in pair), key=lambda shape: int(shape.parentJoint))
            corners, radius = _corners(shapes[far.name], far.placement)
            own = int(far.parentJoint)
            row[own - 1] = np.linalg.norm(corners[:, :2], axis=1).max() + radius
            reach = float(np.linalg.norm(corners, axis=1).max()) + radius
            for joint in range(own - 1, int(near.parentJoint), -1):
                reach += links[joint - 1]
                row[joint - 1] = reach
        return swing

    def touching(self, joints: Joints, allowed: Sequence[Pair] = ()) -> list[Pair]:
        """The pairs closer than the margin at the joint angles (6,) rad, without the `allowed` ones."""
        pin.computeCollisions(self._model, self._data, self._geometry, self._geometry_data, _array(joints), False)
        excused = {frozenset(pair) for pair in allowed}
        results = self._geometry_data.collisionResults
        return [
            pair
            for pair, result in zip(self._pairs, results, strict=True)
            if result.isCollision() and frozenset(pair) not in excused
        ]

    def free(self, joints: Joints, allowed: Sequence[Pair] = ()) -> bool:
        """True when no pair touches but the `allowed` ones; faster than `touching` where nothing is allowed."""
        if not allowed:
            return not pin.computeCollisions(
                self._model, self._data, self._geometry, self._geometry_data, _array(joints), True
            )
        return not self.touching(joints, allowed)

    def distance(self, joints: Joints) -> tuple[float, Pair]:
        """Smallest distance in m between two bodies and their names; about 10 ms, for reports."""
        index = pin.computeDistances(self._model, self._data, self._geometry, self._geometry_data, _array(joints))
        return float(self._geometry_data.distanceResults[index].min_distance), self._pairs[index]

    def placed(self, joints: Joints) -> list[Body]:
        """All bodies where they are at the joint angles (6,) rad: the same ones, fixed to the base."""
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._geometry_data, _array(joints))
        return [
            replace(body, parent=BASE, placement=pin.SE3(pose))
            for body, pose in zip(self.bodies, self._geometry_data.oMg, strict=True)
        ]

    def require_free(self, joints: Joints, what: str, allowed: Sequence[Pair] = ()) -> None:
        """Raise `CollisionError`, naming the bodies, when they touch at `joints`; `what` names the pose."""
        pairs = self.touching(joints, allowed)
        if pairs:
            raise self.error(what, pairs)

    def error(self, what: str, pairs: Sequence[Pair]) -> CollisionError:
        """The error that names bodies which touch; `what` names the pose or the way."""
        touching = ", ".join(f"{a} and {b}" for a, b in pairs)
        return CollisionError(
            f"{what}: {touching} would come closer than {1e3 * self.margin:.0f} mm. "
            "Change the pose in the job or move the vehicle"
        )


_least = attrgetter("min_distance")


def _corners(body: Body, placement: pin.SE3) -> tuple[NDArray[np.float64], float]:
    """Points (n, 3) in the frame of the body's joint and a radius around them that together hold the body."""
    half = 0.5 * np.array(body.size)
    signs = product((-1.0, 1.0), repeat=3)
    return np.array([placement.act(np.array(s) * half) for s in signs]), body.radius or 0.0


def _array(joints: Joints) -> NDArray[np.float64]:
    return np.asarray(joints, dtype=np.float64)


def _shape(body: Body) -> coal.ShapeBase:
    if body.radius is None:
        return coal.Box(*body.size)
    return coal.Capsule(body.radius, body.size[2])


def _may_touch(first: Body, second: Body) -> bool:
    """False for bodies that are fixed to each other, joined, or kept apart by the arm's construction."""
    low, high = sorted((first.parent, second.parent))
    if low == high or (low == BASE and high == 1):
        return False
    # The table of links ends with the flange, which turns with joint 6.
    links = (low, min(high, 6))
    if low == BASE:
        return {first.name, second.name} not in ({"base", "upper arm"}, {"base", "shoulder joint"})
    return links[1] - links[0] > 1

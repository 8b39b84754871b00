"""Which bodies of the cell touch at given joint angles, and whether they stay apart all along a way.

Bodies are capsules of the arm, boxes of the tool, the part, the vehicle and the station, generous on purpose. Each
hangs on the arm's base (fixed), on one of the six joints or on the flange. Bodies that are joined to each other are not
checked, and a caller may allow named pairs, such as the part and the surface in the guarded descent.

Between the samples of a way: no joint can bring a pair nearer faster than the farther body reaches from its axis. So
the next look may be as far along as no pair can have met before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from operator import attrgetter

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.motion.kinematics import MODELS, ArmKinematics, Joints
from drivers.errors import RefusedError

BASE = 0
"""Parent of what stands still: poses are in the arm's base frame."""
FLANGE = 7
"""Parent of what the flange carries: poses are in the flange frame. 1 … 6 are the frames that turn with a joint."""


PLACED = "placed part"
"""The part once it was let go: it stands still."""
TOUCHES = (("part", "surface"), ("part", "table"), ("claw", "surface"), ("claw", PLACED))
"""What comes near on purpose while the part is set down and left."""


@dataclass(frozen=True)
class Body:
    """A box (`size` x, y, z) or, when `radius` is given, a capsule along its z axis with a core of length `size[2]`."""

    name: str
    parent: int
    placement: pin.SE3
    size: tuple[float, float, float]
    radius: float | None = None


def box(name: str, parent: int, placement: pin.SE3, size: Sequence[float]) -> Body:
    """A box centred at `placement` with edge lengths `size` (3), m."""
    if len(size) != 3 or not all(s > 0 for s in size):
        raise ValueError(f"size of the box {name!r} is {tuple(size)} m; three lengths greater than 0 are needed")
    return Body(name, parent, placement, (float(size[0]), float(size[1]), float(size[2])))


def block(name: str, parent: int, low: Sequence[float], high: Sequence[float]) -> Body:
    """A box with edges along its parent's axes from corner `low` to corner `high` (3), m."""
    lower, upper = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    return box(name, parent, pin.SE3(np.eye(3), (lower + upper) / 2), [float(v) for v in upper - lower])


def capsule(name: str, parent: int, start: Sequence[float], end: Sequence[float], radius: float) -> Body:
    """A capsule around the segment from `start` to `end` (3), m."""
    p, q = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.linalg.norm(q - p))
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), (q - p) / length)
    return Body(name, parent, pin.SE3(turn.toRotationMatrix(), (p + q) / 2), (0.0, 0.0, length), radius)


def arm_bodies(model: str = "UR10e") -> list[Body]:
    """Capsules around the links of an arm, in the frames that turn with its joints (z along the joint's axis)."""
    arm = MODELS[model]
    (beside, thick), (fore, slim) = arm.upper, arm.forearm
    return [
        capsule("base", BASE, (0, 0, 0.3 * arm.base), (0, 0, 0.8 * arm.base), arm.base),
        capsule("shoulder", 1, (0, 0, arm.d1 - 0.25 * thick), (0, -0.68 * beside, arm.d1), 1.1 * thick),
        capsule("shoulder joint", 2, (0, 0, beside - 0.4 * thick), (0, 0, beside + 0.5 * thick), thick),
        capsule("upper arm", 2, (0, 0, beside), (arm.a2, 0, beside), thick),
        capsule("elbow", 3, (0, 0, fore), (0, 0, beside + 0.5 * thick), thick),
        capsule("forearm", 3, (0, 0, fore), (arm.a3, 0, fore), slim),
        capsule("wrist 1", 4, (0, 0, fore + 0.01), (0, 0, arm.d4 + 0.01), arm.wrist),
        capsule("wrist 2", 5, (0, 0, 0), (0, 0, arm.d5 + 0.01), arm.wrist),
        capsule("wrist 3", 6, (0, 0, 0.03), (0, 0, arm.d6 - 0.036), 0.9 * arm.wrist),
    ]


_ACROSS = pin.SE3(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


@dataclass(frozen=True)
class Mounted:
    """What the flange carries beside the claw: flange_from_camera of both cameras, the scan camera's with the carriage
    at 0, the laser's `baseline` and the rail's `travel`, m. The carriage runs along the scan camera's x axis."""

    scan: pin.SE3 = field(default_factory=lambda: pin.SE3(_ACROSS.rotation, np.array([0.09, -0.05, 0.08])))
    target: pin.SE3 = field(default_factory=lambda: pin.SE3(_ACROSS.rotation, np.array([-0.10, 0.0, 0.03])))
    baseline: float = 0.035
    travel: tuple[float, float] = (0.0, 0.100)


def tool_bodies(
    part_size: Sequence[float] | None = None, flange_from_part: pin.SE3 | None = None, mounted: Mounted | None = None
) -> list[Body]:
    """Claw, rail with the scan head over its whole travel, target camera, and the part when it is held.

    The part's frame has its origin in the mating face, z into the part; `part_size` is its extent along its x, y, z.
    Without `mounted`, cameras and rail are those of the configuration that ships.
    """
    on = mounted or Mounted()
    first, last = min(0.0, on.travel[0]), max(0.0, on.travel[1])
    bodies = [
        block("claw", FLANGE, (-0.03, -0.03, 0.0), (0.03, 0.03, 0.145)),
        _on_camera("scan head", on.scan, (first - on.baseline - 0.025, -0.025, -0.06), (last + 0.03, 0.025, 0.01)),
        _on_camera("target camera", on.target, (-0.025, -0.025, -0.06), (0.025, 0.025, 0.02)),
    ]
    if part_size is not None:
        x, y, z = part_size
        placement = (flange_from_part or pin.SE3.Identity()) * pin.SE3(np.eye(3), np.array([0.0, 0.0, z / 2]))
        bodies.append(box("part", FLANGE, placement, (x, y, z)))
    return bodies


def _on_camera(name: str, flange_from_camera: pin.SE3, low: Sequence[float], high: Sequence[float]) -> Body:
    """A box with edges along a camera's axes; along the flange's own where those are the same lines."""
    turn = flange_from_camera.rotation
    if np.abs(turn - turn.round()).max() < 1e-9:
        ends = np.array([turn.round() @ corner + flange_from_camera.translation for corner in (low, high)]).round(9)
        return block(name, FLANGE, ends.min(axis=0).tolist(), ends.max(axis=0).tolist())
    local = block(name, FLANGE, low, high)
    return box(name, FLANGE, flange_from_camera * local.placement, local.size)


def vehicle_bodies(plates: Sequence[tuple[str, pin.SE3, Sequence[float]]] = ()) -> list[Body]:
    """The vehicle's deck below the arm and the calibration plates on it: name, base_from_centre, size (x, y, z)."""
    deck = block("deck", BASE, (-0.80, -0.40, -0.30), (0.20, 0.40, -0.005))
    return [deck, *(box(name, BASE, pose, size) for name, pose, size in plates)]


def station_bodies(
    base_from_place: pin.SE3,
    place_from_board_centre: pin.SE3,
    place_from_surface: pin.SE3 | None = None,
    surface_extent: tuple[Sequence[float], Sequence[float]] = ((-0.035, -0.018, 0.0), (0.035, 0.018, 0.015)),
) -> list[Body]:
    """Table, nominal surface, board and its post, placed by the measured pose of the place frame in the arm base.
    `surface_extent` are the lowest and the highest corner of the surface in its own frame, m."""

    def placed(name: str, low: Sequence[float], high: Sequence[float]) -> Body:
        local = block(name, BASE, low, high)
        return box(name, BASE, base_from_place * local.placement, local.size)

    (x, y, z), over = surface_extent
    surface = block("surface", BASE, (x, y, z - 0.002), over)
    on_place = (place_from_surface or pin.SE3.Identity()) * surface.placement
    cx, cy, cz = place_from_board_centre.translation
    board = base_from_place * place_from_board_centre * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.006]))
    return [
        placed("table", (-0.35, -0.50, -0.60), (0.45, 0.50, -0.002)),
        box("surface", BASE, base_from_place * on_place, surface.size),
        placed("board post", (cx, cy - 0.02, -0.002), (cx + 0.04, cy + 0.02, cz)),
        box("board", BASE, board, (0.21, 0.17, 0.01)),
    ]


Pair = tuple[str, str]
ROUNDING = 1e-4
"""Bodies count as touching this much in m before the margin, so that between two looks at a way the margin is kept."""


class CollisionError(RefusedError):
    """A pose or every path found would make bodies touch; the text names them."""


class CollisionModel:
    """Bodies of the arm, of what it carries and of its surroundings. One instance per thread. `margin` is the distance
    in m below which two bodies count as touching."""

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
            shape = coal.Box(*body.size) if body.radius is None else coal.Capsule(body.radius, body.size[2])
            self._geometry.addGeometryObject(pin.GeometryObject(body.name, joint, placement, shape))
        self.pairs: list[Pair] = []
        """The pairs of bodies that are looked at, in the order of `distances`."""
        for i, first in enumerate(bodies):
            for j in range(i + 1, len(bodies)):
                if _may_touch(first, bodies[j]):
                    self._geometry.addCollisionPair(pin.CollisionPair(i, j))
                    self.pairs.append((first.name, bodies[j].name))
        self._geometry_data = self._geometry.createData()
        for request in self._geometry_data.collisionRequests:
            request.security_margin = margin + ROUNDING
        results = self._geometry_data.distanceResults
        self._distance_results = [results[i] for i in range(len(self.pairs))]
        self.swing = self._swing()

    def distances(self, joints: Joints) -> NDArray[np.float64]:
        """(pairs,) distance in m of each pair at the joint angles (6,) rad, negative where they overlap."""
        pin.computeDistances(self._model, self._data, self._geometry, self._geometry_data, _array(joints))
        return np.fromiter(map(_least, self._distance_results), np.float64, len(self.pairs))

    def excused(self, allowed: Sequence[Pair]) -> NDArray[np.bool_]:
        """(pairs,) which of the pairs are among the `allowed` ones."""
        names = {frozenset(pair) for pair in allowed}
        return np.array([frozenset(pair) in names for pair in self.pairs], dtype=np.bool_)

    def _swing(self) -> NDArray[np.float64]:
        """(pairs, 6) by how many m a pair can come nearer, at most, when a joint between the two turns by 1 rad. That
        is how far from the joint's axis the farther body can reach: its own corners, and the links in between."""
        links = [float(np.linalg.norm(self._model.jointPlacements[k].translation)) for k in range(2, 7)]
        swing = np.zeros((len(self.pairs), 6))
        shapes = {body.name: body for body in self.bodies}
        objects = {shape.name: shape for shape in self._geometry.geometryObjects}
        for row, pair in zip(swing, self.pairs, strict=True):
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
        self._collide(joints, first_only=False)
        excused = {frozenset(pair) for pair in allowed}
        results = self._geometry_data.collisionResults
        return [
            pair
            for pair, result in zip(self.pairs, results, strict=True)
            if result.isCollision() and frozenset(pair) not in excused
        ]

    def free(self, joints: Joints, allowed: Sequence[Pair] = ()) -> bool:
        """True when no pair touches but the `allowed` ones; faster than `touching` where nothing is allowed."""
        if not allowed:
            return not self._collide(joints, first_only=True)
        return not self.touching(joints, allowed)

    def _collide(self, joints: Joints, *, first_only: bool) -> bool:
        """Whether any two bodies collide; with `first_only` the pairs after the first are not looked at."""
        data = self._model, self._data, self._geometry, self._geometry_data
        return bool(pin.computeCollisions(*data, _array(joints), first_only))

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


GIVE = 3e-4
"""By how much in m a pair that touches at the beginning may come nearer again: the arm holds its place no better."""
AHEAD = 256
"""Samples of a way that are looked at together."""


@dataclass(frozen=True, eq=False)
class FirstContact:
    """Where on a way bodies touch first: joint angles (6,) rad, about which sample that is, and the pairs."""

    joints: Joints
    sample: int
    pairs: list[Pair]


def first_touch(
    model: CollisionModel, way: NDArray[np.float64], allowed: tuple[Pair, ...] = (), opening: bool = False
) -> FirstContact | None:
    """The first touch on a way (n, 6) rad, straight in joint angles between its samples; None when it is free.

    Pairs in `allowed` are not looked at. With `opening`, pairs that are nearer than the margin at the beginning may be
    so as long as they do not come nearer still; once they have parted they count like all others. On a free way every
    pair keeps the model's margin everywhere.
    """
    samples = np.asarray(way, dtype=np.float64)
    turned = np.vstack([np.zeros(6), np.cumsum(np.abs(np.diff(samples, axis=0)), axis=0)])
    kept = model.margin + ROUNDING
    apart = model.distances(samples[0])
    needed = np.where(model.excused(allowed), -np.inf, kept)
    if opening:
        needed = np.minimum(needed, apart - GIVE)
    place, sample = turned[0], 0
    joints = samples[0]
    while True:
        met = apart < needed
        if met.any():
            return FirstContact(joints, sample, [pair for pair, close in zip(model.pairs, met, strict=True) if close])
        if sample == len(samples) - 1:
            return None
        if opening:
            needed = np.where(needed > -np.inf, np.maximum(needed, np.minimum(kept, apart - GIVE)), needed)
        room = np.maximum(apart - needed, 2.0 * ROUNDING)
        joints, place, sample = _onwards(model, samples, turned, place=place, sample=sample, room=room)
        apart = model.distances(joints)


def _onwards(
    model: CollisionModel, samples: NDArray[np.float64], turned: NDArray[np.float64], place: Joints, sample: int,
    room: NDArray[np.float64],
) -> tuple[Joints, Joints, int]:  # fmt: skip
    """As far along as no pair can have come nearer by more than its `room` (pairs,) m.

    `turned` (n, 6) is by how much each joint has turned since the beginning, `place` (6,) the same where the last look
    was, after `sample`. Returns the joint angles, the new `place` and the last sample that was reached.
    """
    nearer = (turned[sample + 1 : sample + 1 + AHEAD] - place) @ model.swing.T
    beyond = (nearer > room).any(axis=1)
    if not beyond.any():
        reached = sample + len(nearer)
        return samples[reached], turned[reached], reached
    first = int(np.argmax(beyond))
    last = sample + first
    leg = turned[last + 1] - turned[last]
    begun = max(0.0, float(np.max((place - turned[last])[leg > 0] / leg[leg > 0]))) if first == 0 else 0.0
    from_there = (turned[last] + begun * leg - place) @ model.swing.T
    rates = leg @ model.swing.T
    moving = rates > 0
    fraction = begun + float(np.min((room - from_there)[moving] / rates[moving]))
    return samples[last] + fraction * (samples[last + 1] - samples[last]), turned[last] + fraction * leg, last

"""What is solid in the world and must not meet: vehicle, arm and tool, table, board and its post, floor.

Coarse on purpose, and never larger than the real thing: points with a radius along the arm and at the tool's corners,
boxes for what stands. The part's and the fingertips' contact with the ground is `contact`'s business. The plates on the
deck are left out.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backends.world import nominal
from sim_backends.world.contact import PartContact
from sim_backends.world.nominal import inverse
from sim_backends.world.scene import Scene

Pose = NDArray[np.float64]
Vector = NDArray[np.float64]

PERIOD_S = 0.05
"""The arm is looked at this often, in world seconds, while it or the vehicle moves."""
DEEPER_M = 0.005
"""Two bodies that touch already collide anew when they press by this much deeper."""
LONGEST = 100
"""So many collisions are kept."""

FOOTPRINT = np.array([[0.5, 0.4], [0.5, -0.4], [-0.5, -0.4], [-0.5, 0.4]])
"""Corners (4, 2) of the vehicle on the floor, m, in V."""
_DECK = np.array([[-0.5, -0.4, 0.25], [0.5, 0.4, 0.54]])
_FAR = 1.5
"""From further away, m, no corner of the vehicle reaches the station at the world's origin."""
_POST = np.array([[0.10, 0.305], [0.14, 0.305], [0.14, 0.335], [0.10, 0.335]])
_POST_TOP = 0.12
_BOARD_HALF = np.array([0.10, 0.08, 0.005])


@dataclass(frozen=True)
class Collision:
    """`body` met `obstacle` at world time `time`, s."""

    time: float
    body: str
    obstacle: str


class Collisions:
    """Finds and remembers what meets what; safe between threads."""

    def __init__(self, scene: Scene, ground: PartContact) -> None:
        self._ground = ground
        post = _lifted(_POST, nominal.WORLD_FROM_PLACE)
        table = nominal.TABLE_HALF * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
        self._standing = {"table": _lifted(table, scene.world_from_surface), "board post": post}
        board = scene.world_from_board.copy()
        size = np.array(nominal.LARGE_BOARD_SIZE)
        board[:3, 3] += board[:3, :2] @ (0.5 * size) + board[:3, 2] * _BOARD_HALF[2]
        middle = 0.5 * (nominal.TABLE_HEIGHT + _POST_TOP)
        post_pose = np.eye(4)
        post_pose[:3, 3] = [*post.mean(axis=0), middle]
        self._boxes = {
            "board": (inverse(board), _BOARD_HALF),
            "board post": (inverse(post_pose), np.array([*(0.5 * np.ptp(post, axis=0)), middle])),
        }
        self._lock = threading.Lock()
        self._found: list[Collision] = []
        self._touching: dict[tuple[str, str], float] = {}
        self._checked: tuple[float, Vector, Pose] | None = None
        self._against = ""

    @property
    def found(self) -> tuple[Collision, ...]:
        """All collisions so far, oldest first."""
        with self._lock:
            return tuple(self._found)

    def note(self, time: float, body: str, obstacle: str) -> None:
        """Remember one."""
        with self._lock:
            if len(self._found) < LONGEST:
                self._found.append(Collision(time, body, obstacle))

    # --- the vehicle ---

    def blocks(self, time: float, pose: tuple[float, float, float]) -> bool:
        """Whether the vehicle at x, y, yaw would stand in something; remembered as a collision once a contact."""
        if math.hypot(pose[0], pose[1]) > _FAR:
            self._against = ""
            return False
        c, s = np.cos(pose[2]), np.sin(pose[2])
        corners = FOOTPRINT @ np.array([[c, s], [-s, c]]) + np.array(pose[:2])
        met = next((name for name, other in self._standing.items() if _overlap(corners, other)), "")
        if met and met != self._against:
            self.note(time, "vehicle", met)
        self._against = met
        return bool(met)

    # --- the arm ---

    def due(self, time: float, joints: Vector, world_from_base: Pose) -> bool:
        """Whether the arm is to be looked at now: time has passed since the last look, and something has moved."""
        if self._checked is not None:
            last, q, pose = self._checked
            if time - last < PERIOD_S or (np.array_equal(q, joints) and np.array_equal(pose, world_from_base)):
                return False
        self._checked = (time, joints.copy(), world_from_base.copy())
        return True

    def arm(self, time: float, points: Vector, world_from_vehicle: Pose) -> str | None:
        """What the arm has just met, in words, or None: `points` (n, 3) as of `ArmPoints.at`, in the world.

        The part touches only what is not the ground here.
        """
        vehicle = _moved(points, inverse(world_from_vehicle)) - _DECK.mean(axis=0)
        depths = {name: _inside(_moved(points, pose), half) for name, (pose, half) in self._boxes.items()}
        depths["vehicle"] = _inside(vehicle, 0.5 * np.ptp(_DECK, axis=0))
        below, on_table = self._ground.below(points)
        held = ArmPoints.body == ArmPoints.names.index("part")
        depths["table"] = np.where(on_table & ~held, below, -np.inf)
        depths["floor"] = np.where(on_table | held, -np.inf, below)
        now: dict[tuple[str, str], float] = {}
        for obstacle, depth in depths.items():
            deep = depth + ArmPoints.radius
            for point in np.flatnonzero(deep > 0.0):
                pair = (ArmPoints.names[ArmPoints.body[point]], obstacle)
                now[pair] = max(now.get(pair, 0.0), float(deep[point]))
        new = [pair for pair, depth in now.items() if depth > self._touching.get(pair, -np.inf) + DEEPER_M]
        self._touching = {pair: depth if pair in new else self._touching[pair] for pair, depth in now.items()}
        for body, obstacle in new:
            self.note(time, body, obstacle)
        return None if not new else " and ".join(f"the {body} hit the {obstacle}" for body, obstacle in new)


def _corners(low: tuple[float, float, float], high: tuple[float, float, float]) -> Vector:
    grid = np.meshgrid(*zip(low, high, strict=True), indexing="ij")
    return np.stack([axis.ravel() for axis in grid], axis=-1)


class ArmPoints:
    """The points that stand for arm and tool: `body` (n,) indexes `names`, `radius` (n,) is in m."""

    names = ("upper arm", "forearm", "wrist", "claw", "target camera", "scan head", "part")
    # Link, offset along its z at the beginning and the end, link of the end, number of points, of each capsule.
    _LINKS = (
        (0, 1, 0.176, 0.176, 2, 8, 0.065),
        (1, 2, 0.042, 0.042, 3, 9, 0.050),
        (2, 3, 0.060, 0.150, 3, 3, 0.040),
        (2, 4, 0.000, 0.100, 4, 3, 0.040),
        (2, 5, 0.030, 0.060, 5, 2, 0.040),
    )
    _CLAW = _corners((-0.028, -0.028, 0.03), (0.028, 0.028, 0.14))
    _TARGET = _corners((-0.12, -0.02, -0.02), (-0.08, 0.02, 0.045))
    _SCAN = _corners((-0.05, -0.02, -0.055), (0.02, 0.02, 0.005))
    body = np.repeat([*(row[0] for row in _LINKS), 3, 4, 5, 6], [*(row[5] for row in _LINKS), 8, 8, 8, 8])
    radius = np.repeat([*(row[6] for row in _LINKS), 0.0], [*(row[5] for row in _LINKS), 32])
    _first = np.repeat([row[1] for row in _LINKS], [row[5] for row in _LINKS])
    _last = np.repeat([row[4] for row in _LINKS], [row[5] for row in _LINKS])
    _share = np.concatenate([np.linspace(1.0 / 8 if row[0] == 0 else 0.0, 1.0, row[5]) for row in _LINKS])[:, None]
    _offset = np.repeat([row[2] for row in _LINKS], [row[5] for row in _LINKS])[:, None]
    _rise = np.repeat([row[3] for row in _LINKS], [row[5] for row in _LINKS])[:, None]

    def __init__(self, half_x: float, half_y: float) -> None:
        """For a part of this half length and half width, m."""
        part = _moved(_corners((-half_x, -half_y, 0.0), (half_x, half_y, 0.018)), nominal.FLANGE_FROM_PART)
        self._on_flange = np.concatenate([self._CLAW, self._TARGET])
        self._part = part

    def at(self, frames: Pose, flange_from_scan: Pose, held: bool) -> Vector:
        """The points (n, 3) in the arm's base; `frames` (7, 4, 4) are those of base and links, the last the flange's.

        A part that the claw does not hold is left out: its points are at the flange, inside the wrist.
        """
        along = frames[self._first, :3, 2]
        start = frames[self._first, :3, 3] + self._offset * along
        end = frames[self._last, :3, 3] + self._rise * along
        flange = frames[6]
        part = self._part if held else np.zeros_like(self._part)
        tool = np.concatenate([self._on_flange, _moved(self._SCAN, flange_from_scan), part])
        return np.concatenate([start + self._share * (end - start), _moved(tool, flange)])


def _inside(points: Vector, half: Vector) -> Vector:
    """How deep (n,) each of `points` (n, 3) is inside a box of `half` (3,) edges about the origin; outside of it the
    distance, negative."""
    beyond = np.abs(points) - half
    outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=1))
    depth: Vector = -np.where(outside > 0.0, outside, beyond.max(axis=1))
    return depth


def _lifted(corners: Vector, pose: Pose) -> Vector:
    """Corners (n, 2) of a plane figure in `pose` seen from above, (n, 2) in W."""
    return corners @ pose[:2, :2].T + pose[:2, 3]


def _moved(points: Vector, a_from_b: Pose) -> Vector:
    moved: Vector = points @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return moved


def _overlap(first: Vector, second: Vector) -> bool:
    """Whether two convex figures, corners (n, 2) in order, overlap: no edge of either separates them."""
    for corners in (first, second):
        edges = np.roll(corners, -1, axis=0) - corners
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        a, b = first @ normals.T, second @ normals.T
        if np.any((a.max(axis=0) < b.min(axis=0)) | (b.max(axis=0) < a.min(axis=0))):
            return False
    return True

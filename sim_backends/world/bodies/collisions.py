"""What is solid in the world and must not meet: vehicle, arm and tool, table, board and its post, floor, obstacles.

Coarse on purpose, and never larger than the real thing: points with a radius along the arm and at the tool's corners,
boxes for what stands. The part's and the fingertips' contact with the ground is `contact`'s business. The plates on the
deck are left out.
"""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sim_backends.models.arm_kinematics import TABLES
from sim_backends.optics.scene import Board
from sim_backends.world import drawing
from sim_backends.world.bodies.contact import PartContact, moved_by
from sim_backends.world.drawing import Box, Drawing, inverse
from sim_backends.world.scene import Scene

Pose = NDArray[np.float64]
Vector = NDArray[np.float64]

BODIES = ("upper arm", "forearm", "wrist", "claw", "target camera", "scan head", "part")


class _Links(NamedTuple):
    """How far upper arm and forearm lie beside joint 2, along its axis, then the radii of both and of the wrist, m."""

    upper: float
    fore: float
    upper_radius: float
    fore_radius: float
    wrist_radius: float


_SMALL = _Links(0.120, 0.027, 0.048, 0.036, 0.035)
_MIDDLE = _Links(0.138, 0.007, 0.058, 0.045, 0.036)
_LARGE = _Links(0.176, 0.042, 0.065, 0.050, 0.040)
_HEAVY = _Links(0.260, 0.043, 0.080, 0.065, 0.045)
_OF = {
    "UR3": _SMALL, "UR3e": _SMALL, "UR5": _MIDDLE, "UR5e": _MIDDLE, "UR7e": _MIDDLE, "UR10": _LARGE, "UR10e": _LARGE,
    "UR12e": _LARGE, "UR16e": _LARGE, "UR20": _HEAVY, "UR30": _HEAVY,
}  # fmt: skip
"""Shoulder and elbow offsets of the maker's description of each arm (ur_description); radii of the thinner tubes."""


def _corners(low: tuple[float, float, float], high: tuple[float, float, float]) -> Vector:
    return np.array(list(product(*zip(low, high, strict=True))))


class ArmPoints:
    """The points of one cell: `body` (n,) indexes `BODIES`, `radius` (n,) is in m."""

    _CLAW = _corners((-0.028, -0.028, 0.03), (0.028, 0.028, 0.14))
    _TARGET = _corners((-0.02, -0.02, -0.05), (0.02, 0.02, 0.015))

    def __init__(self, drawing: Drawing) -> None:
        """For the arm, the mounted cameras, the laser and the part of `drawing`."""
        cell, station = drawing.cell, drawing.station
        links, d = _OF[cell.arm], TABLES[cell.arm][:, 1]
        # Body, link, offset along its z at the beginning and the end, link of the end, number of points, radius.
        rows = (
            (0, 1, links.upper, links.upper, 2, 8, links.upper_radius),
            (1, 2, links.fore, links.fore, 3, 9, links.fore_radius),
            (2, 3, links.fore + 0.018, d[3] - 0.024, 3, 3, links.wrist_radius),
            (2, 4, 0.0, d[4] - 0.020, 4, 3, links.wrist_radius),
            (2, 5, 0.030, d[5] - 0.055, 5, 2, links.wrist_radius),
        )
        counts = [row[5] for row in rows]
        self.body = np.repeat([*(row[0] for row in rows), 3, 4, 5, 6], [*counts, 8, 8, 8, 8])
        self.radius = np.repeat([*(row[6] for row in rows), 0.0], [*counts, 32])
        self._first = np.repeat([row[1] for row in rows], counts)
        self._last = np.repeat([row[4] for row in rows], counts)
        shares = [np.linspace(1.0 / 8 if row[0] == 0 else 0.0, 1.0, row[5]) for row in rows]
        self._share = np.concatenate(shares)[:, None]
        self._offset = np.repeat([row[2] for row in rows], counts)[:, None]
        self._rise = np.repeat([row[3] for row in rows], counts)[:, None]
        target = moved_by(self._TARGET, cell.target.mounting)
        self._on_flange = np.concatenate([self._CLAW, target])
        # The camera and its laser, in the camera's frame.
        self._scan = _corners((-cell.baseline - 0.015, -0.02, -0.055), (0.02, 0.02, 0.005))
        x, y, z = station.part_size
        part = _corners((-0.5 * x, -0.5 * y, 0.0), (0.5 * x, 0.5 * y, 0.9 * z))
        self._part = moved_by(part, station.flange_from_part)

    def at(self, frames: Pose, flange_from_scan: Pose, held: bool) -> Vector:
        """The points (n, 3) in the arm's base; `frames` (7, 4, 4) are those of base and links, the last the flange's. A
        part that the claw does not hold is left out: its points are at the flange, inside the wrist."""
        along = frames[self._first, :3, 2]
        start = frames[self._first, :3, 3] + self._offset * along
        end = frames[self._last, :3, 3] + self._rise * along
        flange = frames[6]
        part = self._part if held else np.zeros_like(self._part)
        tool = np.concatenate([self._on_flange, moved_by(self._scan, flange_from_scan), part])
        return np.concatenate([start + self._share * (end - start), moved_by(tool, flange)])


PERIOD_S = 0.05
"""The arm is looked at this often, in world seconds, while it or the vehicle moves."""
DEEPER_M = 0.005
"""Two bodies that touch already collide anew when they press by this much deeper."""
LONGEST = 100

DECK = np.array([[-0.8, -0.4, -0.30], [0.2, 0.4, -0.01]])
"""Lowest and highest corner (2, 3) of the vehicle, m, in the arm's base, which stands on it."""
_FAR = 1.5
"""From further away, m, no corner of the stock vehicle reaches the station at the world's origin."""
_POST = np.array([[0.0, -0.015], [0.04, -0.015], [0.04, 0.015], [0.0, 0.015]])
"""Corners (4, 2) of the board's post, m, from the board's middle along the place frame's axes."""


_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""Of a box of half edges 1."""


@dataclass(frozen=True)
class Collision:
    """`body` met `obstacle` at world time `time`, s."""

    time: float
    body: str
    obstacle: str


class Collisions:
    """Finds and remembers what meets what; safe between threads."""

    def __init__(
        self, scene: Scene, ground: PartContact, found: tuple[Collision, ...] = (), others: Sequence[Scene] = ()
    ) -> None:
        """`found` are collisions from before, `others` the scenes of other stops."""
        self._ground = ground
        self._arm = ArmPoints(scene.drawing)
        base = scene.vehicle_from_base
        low, high = DECK
        self._base_from_vehicle = inverse(base)
        footprint = np.array([[high[0], high[1]], [high[0], low[1]], [low[0], low[1]], [low[0], high[1]]])
        self._footprint = _lifted(footprint, base)
        deck = np.eye(4)
        deck[:3, 3] = -DECK.mean(axis=0)
        on_vehicle = {f"obstacle {name}": _box(box) for name, box in scene.drawing.cell.obstacles.items()}
        self._on_vehicle = _Boxes({**on_vehicle, "vehicle": (deck, 0.5 * np.ptp(DECK, axis=0))})
        self._standing, boxes = _standing(scene)
        for other in others:
            outlines, more = _standing(other)
            of = f"of stop {other.drawing.station.stop}"
            self._standing |= {f"{name} {of}": outline for name, outline in outlines.items()}
            boxes |= {f"{name} {of}": box for name, box in more.items()}
        farthest = max(float(np.hypot(*outline.T).max()) for outline in self._standing.values())
        self._far = max(_FAR, float(np.hypot(*self._footprint.T).max()) + farthest)
        self._standing_boxes = _Boxes(boxes)
        self._solid = (*boxes, *on_vehicle, "vehicle", "table", "floor")
        self._lock = threading.Lock()
        self._found: list[Collision] = list(found)
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

    def blocks(self, time: float, pose: tuple[float, float, float]) -> bool:
        """Whether the vehicle at x, y, yaw would stand in something; remembered as a collision once a contact."""
        if math.hypot(pose[0], pose[1]) > self._far:
            self._against = ""
            return False
        c, s = np.cos(pose[2]), np.sin(pose[2])
        corners = self._footprint @ np.array([[c, s], [-s, c]]) + np.array(pose[:2])
        met = next((name for name, other in self._standing.items() if _overlap(corners, other)), "")
        if met and met != self._against:
            self.note(time, "vehicle", met)
        self._against = met
        return bool(met)

    def due(self, time: float, joints: Vector, world_from_base: Pose) -> bool:
        """Whether the arm is to be looked at now: time has passed since the last look, and something has moved."""
        if self._checked is not None:
            last, q, pose = self._checked
            if time - last < PERIOD_S or (np.array_equal(q, joints) and np.array_equal(pose, world_from_base)):
                return False
        self._checked = (time, joints.copy(), world_from_base.copy())
        return True

    def arm(self, time: float, points: Vector, world_from_vehicle: Pose) -> str | None:
        """What the arm has just met, in words, or None: `points` (n, 3) as of `ArmPoints.at`, in the world. The part
        touches only what is not the ground here."""
        in_base = moved_by(moved_by(points, inverse(world_from_vehicle)), self._base_from_vehicle)
        depths = [self._standing_boxes.depths(points), self._on_vehicle.depths(in_base)]
        if not self._ground.clear(points, self._arm.radius):
            below, on_table = self._ground.below(points)
            held = self._arm.body == BODIES.index("part")
            depths.append(np.where(on_table & ~held, below, -np.inf)[None])
            depths.append(np.where(on_table | held, -np.inf, below)[None])
        deep = np.concatenate(depths) + self._arm.radius
        now: dict[tuple[str, str], float] = {}
        for obstacle, point in zip(*(found.tolist() for found in np.nonzero(deep > 0.0)), strict=True):
            pair = (BODIES[self._arm.body[point]], self._solid[obstacle])
            now[pair] = max(now.get(pair, 0.0), float(deep[obstacle, point]))
        new = [pair for pair, depth in now.items() if depth > self._touching.get(pair, -np.inf) + DEEPER_M]
        self._touching = {pair: depth if pair in new else self._touching[pair] for pair, depth in now.items()}
        for body, obstacle in new:
            self.note(time, body, obstacle)
        return None if not new else " and ".join(f"the {body} hit the {obstacle}" for body, obstacle in new)


def _standing(scene: Scene) -> tuple[dict[str, Vector], dict[str, tuple[Pose, Vector]]]:
    """What stands at a station: outlines (n, 2) in W of what a vehicle meets, and boxes, box_from_world and half edges,
    of what an arm meets besides the ground."""
    x0, x1, y0, y1 = Board.parse(scene.drawing.station.board).bounds
    board, half = scene.world_from_board.copy(), np.array([0.5 * (x1 - x0), 0.5 * (y1 - y0), 0.005])
    board[:3, 3] += board[:3, :3] @ [0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0]
    centre = board[:3, 3].copy()
    board[:3, 3] += board[:3, 2] * half[2]
    post_pose = scene.world_from_place.copy()
    post_pose[:3, 3] = [*centre[:2], 0.0]
    post = _lifted(_POST, post_pose)
    table = drawing.TABLE_HALF * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    standing = {"table": _lifted(table, scene.world_from_table), "board post": post}
    middle = 0.5 * centre[2]
    post_pose[:3, 3] = [*post.mean(axis=0), middle]
    boxes = {
        "board": (inverse(board), half),
        "board post": (inverse(post_pose), np.array([*(0.5 * np.ptp(_POST, axis=0)), middle])),
    }
    top = float(scene.vehicle_from_base[2, 3] + DECK[1, 2])
    for name, drawn in scene.drawing.station.obstacles.items():
        centred, size = _box(drawn)
        pose = scene.world_from_place @ inverse(centred)
        boxes[f"station obstacle {name}"] = inverse(pose), size
        corners = moved_by(size * _CORNERS, pose)
        if corners[:, 2].min() < top:
            # As seen from above: the corners of its top and bottom together.
            outline = scipy.spatial.ConvexHull(corners[:, :2])
            standing[f"station obstacle {name}"] = corners[outline.vertices, :2]
    return standing, boxes


class _Boxes:
    """Boxes that stand in one frame, by name the box_from_frame (4, 4) and half edges (3,) of each."""

    def __init__(self, boxes: dict[str, tuple[Pose, Vector]]) -> None:
        poses = np.array([pose for pose, _ in boxes.values()])
        self._turns = np.ascontiguousarray(poses[:, :3, :3].transpose(0, 2, 1))
        self._shifts = poses[:, None, :3, 3]
        self._half = np.array([half for _, half in boxes.values()])[:, None]

    def depths(self, points: Vector) -> Vector:
        """How deep (m, n) each of `points` (n, 3) is inside each of the boxes; outside of one the distance, negative.
        In one go: it is asked for twenty times in a second of the world."""
        beyond = np.abs(points @ self._turns + self._shifts) - self._half
        outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=-1))
        depth: Vector = -np.where(outside > 0.0, outside, beyond.max(axis=-1))
        return depth


def _box(drawn: Box) -> tuple[Pose, Vector]:
    """box_from_frame (4, 4) and half edges (3,) of an obstacle that is drawn in some frame."""
    return inverse(np.array(drawn["pose"], dtype=np.float64)), 0.5 * np.array(drawn["size"], dtype=np.float64)


def _lifted(corners: Vector, pose: Pose) -> Vector:
    """Corners (n, 2) of a plane figure in `pose` seen from above, (n, 2) in W."""
    return corners @ pose[:2, :2].T + pose[:2, 3]


def _overlap(first: Vector, second: Vector) -> bool:
    """Whether two convex figures, corners (n, 2) in order, overlap: no edge of either separates them."""
    for corners in (first, second):
        edges = np.roll(corners, -1, axis=0) - corners
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        a, b = first @ normals.T, second @ normals.T
        if np.any((a.max(axis=0) < b.min(axis=0)) | (b.max(axis=0) < a.min(axis=0))):
            return False
    return True

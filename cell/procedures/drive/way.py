"""Whether a way of the vehicle may be driven: how far on odometry alone, and how close to the station.

Everything is seen from above, in the place frame. The way is the one that the line law would drive without errors; the
room that it needs grows with how far the vehicle has gone, and turned on the spot, since it was last seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from cell.config.job import Job
from cell.config.obstacles import station_obstacles
from cell.measure.geometry.poses import from_parts
from cell.measure.vision import parse_board
from cell.measure.vision.board.spec import centre_of
from cell.motion.bodies import Body, station_bodies, vehicle_bodies
from cell.procedures.drive.approach import Planar, line_command, wrap
from cell.procedures.drive.whereabouts import Whereabouts
from drivers.errors import RefusedError
from drivers.interfaces import Vector

MARGIN = 0.05
"""What stays between vehicle and station, m, when the vehicle has just been seen."""
DRIFT = 0.05
"""More of it for each metre on odometry alone."""
TURN_DRIFT = 0.075
"""What the heading may be off by, rad, for each radian turned on the spot on odometry alone: twice the 1-sigma slip of
a harsh simulated cell, which the wheels of a skid-steered vehicle have most of where it turns."""
ROOM_BEYOND = 0.25
"""How much further than the job's way to its staging pose the vehicle may go on odometry alone, m."""
BACK_UP = 0.45
"""The run that a second try needs to work off an error to the side, m."""
ROOM_ABOVE = 0.03
"""What passes above or below something by more than this, m, does not meet it: floors are that even."""
_STEP_S = 0.05
_STEP_TURN = math.radians(2)
_LONGEST_S = 120.0


@dataclass(frozen=True, eq=False)
class Upright:
    """The upright box around a body: `corners` (4, 2) seen from above and its height from `low` to `high`, m."""

    name: str
    corners: Vector
    low: float
    high: float

    @classmethod
    def of(cls, body: Body, frame_from_parent: pin.SE3) -> Upright:
        """Around a body whose parent is at `frame_from_parent`."""
        pose = frame_from_parent * body.placement
        radius = body.radius or 0.0
        dx, dy, dz = np.abs(pose.rotation) @ (0.5 * np.array(body.size)) + radius
        x, y, z = pose.translation
        corners = np.array([[x + dx, y + dy], [x - dx, y + dy], [x - dx, y - dy], [x + dx, y - dy]])
        return cls(body.name, corners, float(z - dz), float(z + dz))

    @cached_property
    def reach(self) -> float:
        """The farthest corner from the origin, m."""
        return float(np.linalg.norm(self.corners, axis=1).max())

    @cached_property
    def middle(self) -> Vector:
        """(2,), m."""
        middle: Vector = self.corners.mean(axis=0)
        return middle

    @cached_property
    def radius(self) -> float:
        """Of the circle about the middle through the corners, m."""
        return math.dist(self.middle, self.corners[0])

    def beside(self, other: Upright) -> bool:
        """Whether the two could meet if one were moved over the floor."""
        return self.low - ROOM_ABOVE < other.high and other.low - ROOM_ABOVE < self.high


class Way:
    """The ways that the vehicle of one job may go."""

    def __init__(
        self, job: Job, vehicle_from_base: pin.SE3, whereabouts: Whereabouts, carried: Sequence[Body] = ()
    ) -> None:
        """`carried` is what goes with the vehicle besides its deck, in the arm base: arm, tool and part as they are."""
        self._job = job
        self._whereabouts = whereabouts
        board = job.place_from_board * from_parts(centre_of(parse_board(job.board.spec)))
        here = pin.SE3.Identity()
        self._station = [
            Upright.of(body, here) for body in (*station_bodies(here, board), *station_obstacles(job.obstacle, here))
        ]
        # Over the floor the deck's own height does not matter: nothing of a station hangs there.
        deck = replace(Upright.of(vehicle_bodies()[0], vehicle_from_base), low=-math.inf, high=math.inf)
        lifted = from_parts((0.0, 0.0, job.approach.target.se3().translation[2]))
        others = [Upright.of(body, lifted * vehicle_from_base) for body in carried if body.name != "deck"]
        self._vehicle = [deck, *others]
        self._pairs = [(ours, theirs) for ours in self._vehicle for theirs in self._station if ours.beside(theirs)]
        start, staging = Planar.of(job.approach.start.se3()), Planar.of(job.approach.staging.se3())
        self.longest = max(math.hypot(staging.x - start.x, staging.y - start.y), 2 * BACK_UP) + ROOM_BEYOND

    def require_line(self, goal: Planar) -> None:
        """Raise `RefusedError` unless the vehicle may drive along the goal's line to `goal` on odometry."""
        pose, length, turned = self._whereabouts.pose(), self._whereabouts.way, self._whereabouts.turned
        self._require_room(pose, length, turned)
        for _ in range(round(_LONGEST_S / _STEP_S)):
            speed, rate = line_command(pose, goal, self._job.approach.speed)
            if speed == 0.0:
                break
            pose = pose * Planar(speed * _STEP_S, 0.0, rate * _STEP_S)
            length += abs(speed) * _STEP_S
            self._require_room(pose, length, turned)
        if length > self.longest:
            raise RefusedError(
                f"the vehicle would go {length:.2f} m on odometry alone since it was last seen, allowed "
                f"{self.longest:.2f} m; bring it where it sees the board, with `cell jog vehicle`"
            )

    def require_turn(self, yaw: float) -> None:
        """Raise `RefusedError` unless the vehicle may turn on the spot to `yaw`."""
        pose, length, turned = self._whereabouts.pose(), self._whereabouts.way, self._whereabouts.turned
        turn = wrap(yaw - pose.yaw)
        for share in np.linspace(0.0, 1.0, 2 + int(abs(turn) / _STEP_TURN)):
            part = float(share) * turn
            self._require_room(Planar(pose.x, pose.y, pose.yaw + part), length, turned + abs(part))

    def _require_room(self, pose: Planar, length: float, turned: float) -> None:
        c, s = math.cos(pose.yaw), math.sin(pose.yaw)
        turn, shift = np.array([[c, s], [-s, c]]), np.array([pose.x, pose.y])
        # A wrong heading swings the corners, and leads aside on the way after it.
        for ours, theirs in self._pairs:
            needed = MARGIN + DRIFT * length + TURN_DRIFT * turned * (ours.reach + length)
            if math.dist(ours.middle @ turn + shift, theirs.middle) > ours.radius + theirs.radius + needed:
                continue  # Their circles are that far apart.
            room = distance(ours.corners @ turn + shift, theirs.corners)
            if room < needed:
                what = "" if ours is self._vehicle[0] else f"with the arm's {ours.name} "
                raise RefusedError(
                    f"the vehicle's way comes {what}within {1e3 * room:.0f} mm of the {theirs.name} at x {pose.x:.2f} "
                    f"m, y {pose.y:.2f} m in the place frame, allowed {1e3 * needed:.0f} mm; it was not driven. Jog "
                    "it away from the station with `cell jog vehicle`, to before its staging pose"
                )


def distance(first: Vector, second: Vector) -> float:
    """Between two convex outlines, corners (n, 2) in order, m; 0 when they overlap."""
    if _overlap(first, second):
        return 0.0
    return min(_to_edges(first, second), _to_edges(second, first))


def _overlap(first: Vector, second: Vector) -> bool:
    for corners in (first, second):
        edges = np.roll(corners, -1, axis=0) - corners
        normals = np.column_stack([edges[:, 1], -edges[:, 0]])
        a, b = first @ normals.T, second @ normals.T
        if np.any((a.max(axis=0) < b.min(axis=0)) | (b.max(axis=0) < a.min(axis=0))):
            return False
    return True


def _to_edges(points: Vector, corners: Vector) -> float:
    edges = np.roll(corners, -1, axis=0) - corners
    offsets = points[:, None] - corners[None]
    share = np.clip((offsets * edges).sum(axis=2) / (edges**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(offsets - share[:, :, None] * edges, axis=2).min())

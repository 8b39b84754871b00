"""The vehicle's way over the floor: where it stands, and whether it may drive there.

Frame: the place frame seen from above, the line of approach along its x axis. Angles are about z. Odometry tells a
place only from an anchor on: a sighting of the board, or a person's word. The room that a way needs grows with how far
the vehicle has gone, and turned on the spot, since then.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import pinocchio as pin

from cell.config.cell_config import StationObstacle, station_obstacles
from cell.config.job import BoardSection, Job, OtherStop
from cell.measure.geometry.poses import from_parts
from cell.measure.vision.board.view import centre_of, parse_board
from cell.motion.collision import Body, station_bodies, vehicle_bodies
from cell.procedures.drive.driving import MAX_HEADING, Planar, line_command, odometry_of, wrap
from drivers.errors import RefusedError
from drivers.interfaces import Vector, Vehicle, VehicleState

ROUND = 0.2  # m/s, the fastest from the line of another stop onto that of a job: in a bend of half a metre

PLAUSIBLE = 0.10
"""A sighting this far, m, from what odometry says is worth a note."""
PLAUSIBLE_ANGLE = math.radians(5)
STILL = 1e-3
"""What odometry tells of a vehicle that stands is less than this, m or rad."""
TIGHT = 0.3
"""Turns about a point nearer than this, m, count as on the spot: about half the track, the wheels go against each
other and scrub. Wider ones are part of the way."""


@dataclass(frozen=True)
class _Anchor:
    """`pose` in the place frame, or None for the start pose of the job to come, at the odometry's `reading`."""

    pose: Planar | None
    reading: Planar
    interruptions: int


class Whereabouts:
    """The vehicle's pose in the place frame as far as it is known. One for each connected vehicle, used by one thread.

    `way` is how far it has gone, m, and `turned` how far it has turned on the spot, rad, either way, since it was seen
    or said: what odometry may be off by grows with both.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._anchor: _Anchor | None = None
        self._board: BoardSection | None = None
        self._unknown = "this program has just connected to it"
        self._last = Planar(0.0, 0.0, 0.0)
        self.way = self.turned = 0.0

    @property
    def anchored(self) -> bool:
        """Whether a run of this program has worked from a known place already."""
        return self._anchor is not None and self._anchor.pose is not None

    def say_at_start(self) -> None:
        """Take somebody's word that the vehicle stands at the start pose of the job that is run next."""
        self._hold(None)

    def forget_word(self) -> None:
        """The word that was given for one job does not hold for the next, if that job never came to use it."""
        if self._anchor is not None and self._anchor.pose is None:
            self._lose("it was said to stand at the start of another job, which did not begin to drive")

    def enter(self, job: Job) -> None:
        """From now on poses are in the place frame of `job`."""
        if self._anchor is not None and self._anchor.pose is None:
            self._anchor = _Anchor(
                Planar.of(job.approach.start.se3()), self._anchor.reading, self._anchor.interruptions
            )
        elif self._anchor is not None and self._anchor.pose is not None and self._board != job.board:
            there = next((stop.place_from_stop for stop in job.other_stops if stop.board == self._board), None)
            if there is None:
                self._lose("it was last seen by the board of another job")
            else:
                self._anchor = replace(self._anchor, pose=Planar.of(there) * self._anchor.pose)
        self._board = job.board

    def see(self, seen: Planar) -> str | None:
        """The board shows the vehicle at `seen`, standing: odometry counts from there.

        The sighting wins: the job is done by the board, odometry only bridges the way to it, and slips. What
        contradicts odometry by more than `PLAUSIBLE` is returned as a note.
        """
        try:
            before = self.pose()
        except RefusedError:
            before = None
        self._hold(seen)
        if before is None:
            return None
        apart, turned = math.hypot(seen.x - before.x, seen.y - before.y), abs(wrap(seen.yaw - before.yaw))
        if apart <= PLAUSIBLE and turned <= PLAUSIBLE_ANGLE:
            return None
        return (
            f"the board shows the vehicle {1e3 * apart:.0f} mm and {math.degrees(turned):.1f} deg from where odometry "
            f"had it (expected within {1e3 * PLAUSIBLE:.0f} mm and {math.degrees(PLAUSIBLE_ANGLE):.0f} deg); "
            "the board is believed. Look whether its wheels slip, it was pushed, or it did not stand at its start"
        )

    def pose(self) -> Planar:
        """The pose now, by odometry; `RefusedError` that says why when it is not known."""
        state = self._vehicle.state()
        if self._anchor is not None and state.interruptions != self._anchor.interruptions:
            self._lose(state.interruption)
        if self._anchor is None or self._anchor.pose is None:
            raise RefusedError(f"where the vehicle stands is not known: {self._unknown}")
        return self._anchor.pose * self._anchor.reading.inverse() * self._count(state)

    @property
    def still(self) -> bool:
        """Whether the vehicle stands, by odometry, where it was seen last."""
        try:
            self.pose()
        except RefusedError:
            return False
        return max(self.way, self.turned) < STILL

    def count(self) -> None:
        """Count what it has gone since the last look; for those who drive it by other means than `pose`, all the time.
        A way there and back is none between two looks."""
        self._count(self._vehicle.state())

    def _count(self, state: VehicleState) -> Planar:
        now = odometry_of(state)
        way, turn = math.hypot(now.x - self._last.x, now.y - self._last.y), abs(wrap(now.yaw - self._last.yaw))
        self.way += way
        if way < TIGHT * turn:
            self.turned += turn
        self._last = now
        return now

    def _hold(self, pose: Planar | None) -> None:
        state = self._vehicle.state()
        self._anchor = _Anchor(pose, odometry_of(state), state.interruptions)
        self._last, self.way, self.turned = self._anchor.reading, 0.0, 0.0

    def _lose(self, why: str) -> None:
        self._anchor, self._unknown = None, why


def next_step(job: Job) -> str:
    """What a person can do about a vehicle that does not know where it stands."""
    start = Planar.of(job.approach.start.se3())
    return (
        "Nothing was driven. Bring the vehicle where it sees the board, with `cell jog vehicle`; or put it at the "
        f"job's start (x {start.x:.2f} m, y {start.y:.2f} m, {math.degrees(start.yaw):.0f} deg in the place frame) and "
        "say so with --at-start"
    )


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


@dataclass(frozen=True, eq=False)
class Upright:
    """The upright box around a body: `corners` (4, 2) seen from above and its height from `low` to `high`, m."""

    name: str
    corners: Vector
    low: float
    high: float

    @classmethod
    def of(cls, body: Body, frame_from_parent: pin.SE3) -> "Upright":
        """Around a body whose parent is at `frame_from_parent`."""
        pose = frame_from_parent * body.placement
        dx, dy, dz = np.abs(pose.rotation) @ (0.5 * np.array(body.size)) + (body.radius or 0.0)
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

    def beside(self, other: "Upright") -> bool:
        """Whether the two could meet if one were moved over the floor."""
        return self.low - ROOM_ABOVE < other.high and other.low - ROOM_ABOVE < self.high


def speed_onto(job: Job, off: Planar) -> float:
    """How fast, m/s, a vehicle goes onto the line of its goal, whose pose in the goal's frame is `off`."""
    return min(job.approach.speed, ROUND) if job.stop and abs(off.yaw) > MAX_HEADING else job.approach.speed


def left_at(stop: OtherStop) -> Planar:
    """Where the vehicle leaves another stop: at the start of the line there, to which it backs."""
    return Planar.of(stop.place_from_stop) * Planar.of(stop.approach.start.se3())


class Reckoned(Protocol):
    """A vehicle of which is known where it stands in the place frame."""

    @property
    def way(self) -> float:
        """How far it has gone since it was seen, m."""

    @property
    def turned(self) -> float:
        """How far it has turned on the spot since then, rad."""

    def pose(self) -> Planar:
        """The pose now."""


def _standing(place_from_station: pin.SE3, board: BoardSection, obstacles: Sequence[StationObstacle]) -> list[Upright]:
    """What stands at a station, whose own place frame lies there."""
    centre = board.place_from_board.se3() * from_parts(centre_of(parse_board(board.spec)))
    bodies = *station_bodies(place_from_station, centre), *station_obstacles(obstacles, place_from_station)
    return [Upright.of(body, pin.SE3.Identity()) for body in bodies]


class Way:
    """The ways that the vehicle of one job may go."""

    def __init__(
        self, job: Job, vehicle_from_base: pin.SE3, whereabouts: Reckoned, carried: Sequence[Body] = ()
    ) -> None:
        """`carried` is what goes with the vehicle besides its deck, in the arm base: arm, tool and part as they are."""
        self._job = job
        self._whereabouts = whereabouts
        self._station = _standing(pin.SE3.Identity(), job.board, job.obstacle)
        for stop in job.other_stops:
            there = _standing(stop.place_from_stop, stop.board, stop.obstacles)
            self._station += [replace(body, name=f"{body.name} of stop {stop.name}") for body in there]
        # Over the floor the deck's own height does not matter: nothing of a station hangs there.
        deck = replace(Upright.of(vehicle_bodies()[0], vehicle_from_base), low=-math.inf, high=math.inf)
        lifted = from_parts((0.0, 0.0, job.approach.target.se3().translation[2]))
        others = [Upright.of(body, lifted * vehicle_from_base) for body in carried if body.name != "deck"]
        self._vehicle = [deck, *others]
        self._pairs = [(ours, theirs) for ours in self._vehicle for theirs in self._station if ours.beside(theirs)]
        start, staging = Planar.of(job.approach.start.se3()), Planar.of(job.approach.staging.se3())
        ways = [math.hypot(staging.x - start.x, staging.y - start.y), 2 * BACK_UP]
        for stop in job.other_stops:
            # Back to where the line to that stop begins, and round to this one's.
            leave, begin = left_at(stop), Planar.of(stop.place_from_stop * stop.approach.target.se3())
            round_to = abs(staging.x - leave.x) + abs(staging.y - leave.y)
            ways.append(math.hypot(leave.x - begin.x, leave.y - begin.y) + round_to)
        self.longest = max(ways) + ROOM_BEYOND

    def require_line(self, goal: Planar, share: float = 1.0) -> Planar:
        """Where the vehicle comes to stand that drives along the goal's line to `goal` on odometry, at this `share` of
        its speed: a slow one steers less. Raises `RefusedError` unless it may."""
        pose, length, turned = self._whereabouts.pose(), self._whereabouts.way, self._whereabouts.turned
        fastest = speed_onto(self._job, goal.inverse() * pose) * share
        self._require_room(pose, length, turned)
        while length <= self.longest:
            speed, rate = line_command(pose, goal, fastest)
            if speed == 0.0:
                break
            pose = pose * Planar(speed * _STEP_S, 0.0, rate * _STEP_S)
            length += abs(speed) * _STEP_S
            self._require_room(pose, length, turned)
        if length > self.longest:
            length += abs((goal.inverse() * pose).x)
            raise RefusedError(
                f"the vehicle would go {length:.2f} m on odometry alone since it was last seen, allowed "
                f"{self.longest:.2f} m; bring it where it sees the board, with `cell jog vehicle`"
            )
        return pose

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
    return 0.0 if _overlap(first, second) else min(_to_edges(first, second), _to_edges(second, first))


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

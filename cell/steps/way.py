"""Whether a way of the vehicle may be driven: how far on odometry alone, and how close to the station.

Everything is seen from above, in the place frame. The way is the one that the line law would drive without errors; the
room that it needs grows with how far the vehicle has gone, and turned on the spot, since it was last seen.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from cell.geometry.poses import from_parts
from cell.job import Job
from cell.motion.bodies import Body, station_bodies, vehicle_bodies
from cell.steps.approach import Planar, line_command, wrap
from cell.steps.camera_poses import centre_of
from cell.steps.whereabouts import Whereabouts
from cell.vision import parse_board
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
_STEP_S = 0.05
_STEP_TURN = math.radians(2)
_LONGEST_S = 120.0


class Way:
    """The ways that the vehicle of one job may go."""

    def __init__(self, job: Job, vehicle_from_base: pin.SE3, whereabouts: Whereabouts) -> None:
        self._job = job
        self._whereabouts = whereabouts
        board = job.place_from_board * from_parts(centre_of(parse_board(job.board.spec)))
        self._station = {
            body.name: _outline(body, pin.SE3.Identity()) for body in station_bodies(pin.SE3.Identity(), board)
        }
        self._vehicle = _outline(vehicle_bodies()[0], vehicle_from_base)
        self._reach = float(np.linalg.norm(self._vehicle, axis=1).max())
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
        corners = self._vehicle @ np.array([[c, s], [-s, c]]) + np.array([pose.x, pose.y])
        # A wrong heading swings the corners, and leads aside on the way after it.
        needed = MARGIN + DRIFT * length + TURN_DRIFT * turned * (self._reach + length)
        for name, outline in self._station.items():
            room = distance(corners, outline)
            if room < needed:
                raise RefusedError(
                    f"the vehicle's way comes within {1e3 * room:.0f} mm of the {name} at x {pose.x:.2f} m, y "
                    f"{pose.y:.2f} m in the place frame, allowed {1e3 * needed:.0f} mm; it was not driven. Jog it "
                    "away from the station with `cell jog vehicle`, to before its staging pose"
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


def _outline(body: Body, frame_from_parent: pin.SE3) -> Vector:
    """Corners (4, 2) of the upright box around a box, seen from above, m."""
    pose = frame_from_parent * body.placement
    half = np.abs(pose.rotation[:2]) @ (0.5 * np.array(body.size))
    x, y = pose.translation[:2]
    dx, dy = half
    return np.array([[x + dx, y + dy], [x - dx, y + dy], [x - dx, y - dy], [x + dx, y - dy]])

"""Jerk-limited motions in time: joint moves and straight lines, from rest to rest.

Ruckig computes them without waypoints (those would call a cloud service); several moves are joined at rest. What is in
the way is the planner's business, not known here.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import ruckig
from numpy.typing import NDArray

from cell.motion.kinematics import ArmKinematics, JointLimits, Joints
from cell.motion.point_speed import PointSpeed
from drivers.errors import RefusedError

PERIOD = 0.008
"""Time between samples in s; drivers interpolate."""
ROUNDING = 1.0005
SINGULAR = 0.02
"""Manipulability (rad/s of joints per m/s, inverted) below which a straight line is refused."""


class SingularLine(RefusedError):
    """A straight line leads too near a singular posture of the arm."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Samples of a motion: `times` (n,) s from 0, rising; `joints` (n, 6) rad; at rest at both ends."""

    times: NDArray[np.float64]
    joints: NDArray[np.float64]

    @property
    def duration(self) -> float:
        """Seconds from the first to the last sample."""
        return float(self.times[-1])

    @property
    def start(self) -> Joints:
        """Joint angles at the start."""
        first: Joints = self.joints[0]
        return first

    @property
    def end(self) -> Joints:
        """Joint angles at the end."""
        last: Joints = self.joints[-1]
        return last

    def at(self, time: float) -> Joints:
        """Joint angles (6,) at a time in s, linear between samples, held beyond the ends."""
        return np.array([np.interp(time, self.times, column) for column in self.joints.T])

    def at_pace(self, share: float) -> Trajectory:
        """The same way at this share, up to 1, of its speed."""
        return Trajectory(self.times / share, self.joints)

    def speeds(self) -> NDArray[np.float64]:
        """(n - 1, 6) mean joint speeds between samples, rad/s."""
        return np.asarray(np.diff(self.joints, axis=0) / np.diff(self.times)[:, None])


@dataclass(frozen=True)
class LineLimits:
    """Limits of a straight line: speed m/s, acceleration m/s², jerk m/s³ and turning speed rad/s."""

    speed: float = 0.25
    acceleration: float = 0.8
    jerk: float = 8.0
    turn_speed: float = 0.8

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration", "jerk", "turn_speed"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                raise ValueError(f"line limit {name} = {value} must be finite and greater than 0")


def join(parts: Sequence[Trajectory]) -> Trajectory:
    """Motions that follow each other at rest, as one; each must start where the one before it ended."""
    if not parts:
        raise ValueError("no motions to join")
    times, joints = [parts[0].times], [parts[0].joints]
    for before, after in itertools.pairwise(parts):
        if not np.allclose(before.end, after.start, atol=1e-6):
            raise ValueError(f"a motion starts {np.abs(after.start - before.end).max():.2e} rad from the end before it")
        times.append(after.times[1:] + times[-1][-1])
        joints.append(after.joints[1:])
    return Trajectory(np.concatenate(times), np.concatenate(joints))


def plan_joint(
    start: Joints, end: Joints, limits: JointLimits, period: float = PERIOD, points: PointSpeed | None = None
) -> Trajectory:
    """The fastest straight joint move from rest at `start` to rest at `end` within speed, acceleration and jerk.

    Straight in joint space, so that a path checked for collisions is the path that is driven; no faster than `points`
    may be. Raises `RefusedError` when an end lies outside the joint ranges.
    """
    start, end = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64)
    for name, joints in (("start", start), ("end", end)):
        if joints.shape != (6,) or not np.all(np.isfinite(joints)) or not limits.inside(joints):
            raise RefusedError(
                f"{name} of the joint move {np.degrees(joints).round(1).tolist()} deg is outside the ranges "
                f"{np.degrees(limits.lower).round(1).tolist()} … {np.degrees(limits.upper).round(1).tolist()} deg"
            )
    way = np.abs(end - start)
    if way.max() < 1e-9:
        return Trajectory(np.array([0.0, period]), np.stack([start, end]))
    way = np.maximum(way, 1e-12)
    speed, acceleration, jerk = (
        float(np.min(np.array(getattr(limits, name)) / way)) for name in ("speed", "acceleration", "jerk")
    )
    if points is not None:
        speed = min(speed, points.fraction_speed(start, end))
    times, fraction = _profile(speed, acceleration, jerk, period)
    joints = start + fraction[:, None] * (end - start)
    joints[-1] = end
    return Trajectory(times, joints)


def plan_line(
    kinematics: ArmKinematics,
    start: Joints,
    base_from_end: pin.SE3,
    line: LineLimits | None = None,
    period: float = PERIOD,
    points: PointSpeed | None = None,
) -> Trajectory:
    """The flange in a straight line from where `start` (6,) holds it to `base_from_end`, turning evenly on the way.

    The branch of `start` is kept all along. Where a joint or one of `points` would be too fast the whole line is slowed
    down. Raises `Unreachable` when the line leaves the reach and `SingularLine` when it comes too near a singular
    posture.
    """
    line = line or LineLimits()
    start = np.array(start, dtype=np.float64)
    base_from_start = kinematics.fk(start)
    screw = pin.log6(pin.SE3(base_from_start.rotation.T @ base_from_end.rotation, np.zeros(3))).angular
    shift = base_from_end.translation - base_from_start.translation
    distance, angle = float(np.linalg.norm(shift)), float(np.linalg.norm(screw))
    if distance < 1e-7 and angle < 1e-7:
        return Trajectory(np.array([0.0, period]), np.stack([start, start]))
    speed = min(line.speed / max(distance, 1e-9), line.turn_speed / max(angle, 1e-9))
    scale = speed / line.speed
    limit = np.array(kinematics.limits.speed)
    for _ in range(6):
        times, fraction = _profile(speed, line.acceleration * scale, line.jerk * scale, period)
        joints = np.empty((len(times), 6))
        joints[0] = start
        for i, s in enumerate(fraction[1:], start=1):
            pose = pin.SE3(base_from_start.rotation @ pin.exp3(s * screw), base_from_start.translation + s * shift)
            joints[i] = kinematics.track(pose, joints[i - 1])
        trajectory = Trajectory(times, joints)
        _refuse_singular(kinematics, trajectory)
        excess = float((np.abs(trajectory.speeds()) / limit).max())
        if points is not None:
            # The limit of a line that does not turn is met by every point exactly, up to the joints' own accuracy.
            excess = max(excess, points.excess(times, joints) / ROUNDING)
        if excess <= 1.0:
            return trajectory
        speed, scale = speed / (1.05 * excess), scale / (1.05 * excess) ** 2
    raise SingularLine("no speed was found at which every joint can follow the line; choose another posture")


def _refuse_singular(kinematics: ArmKinematics, trajectory: Trajectory) -> None:
    for joints in trajectory.joints[:: max(1, len(trajectory.joints) // 50)]:
        worth = kinematics.manipulability(joints)
        if worth < SINGULAR:
            raise SingularLine(
                f"the line passes a singular posture (manipulability {worth:.3f}, at least {SINGULAR:g} is needed) at "
                f"joints {np.degrees(joints).round(1).tolist()} deg; move the vehicle or choose another posture"
            )


def _profile(
    speed: float, acceleration: float, jerk: float, period: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ruckig's time-optimal way from 0 to 1, from rest to rest: times in s, about `period` apart, and positions."""
    for name, value in {"speed": speed, "acceleration": acceleration, "jerk": jerk, "period": period}.items():
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} {value} must be finite and greater than 0")
    request = ruckig.InputParameter(1)
    request.current_position, request.target_position = [0.0], [1.0]
    request.max_velocity, request.max_acceleration, request.max_jerk = [speed], [acceleration], [jerk]
    profile = ruckig.Trajectory(1)
    result = ruckig.Ruckig(1).calculate(request, profile)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise RefusedError(
            f"no motion within speed {speed:g}, acceleration {acceleration:g} and jerk {jerk:g} (ways per s, s², s³): "
            f"Ruckig reports {result}"
        )
    times = np.linspace(0.0, profile.duration, max(1, int(np.ceil(profile.duration / period - 1e-9))) + 1)
    return times, np.array([profile.at_time(t)[0][0] for t in times])

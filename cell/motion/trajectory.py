"""Jerk-limited motions in time, from rest to rest, no point too fast; and where the flange was at a given time.

Ruckig computes joint moves and straight lines without waypoints (those would call a cloud service). What is in the way
is the planner's business. A point's speed is a convex function of where it is on a rigid body, so the fastest is a
corner: the flange's origin and the corners of all boxes on the flange are enough.

A packet's arrival tells the time of a state only roughly, and late. The arm's own clock runs evenly; round trips tie it
to the host's.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import pinocchio as pin
import ruckig
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_ur
from cell.motion.collision import FLANGE, Body
from cell.motion.kinematics import ArmKinematics, JointLimits, Joints
from drivers.clock import ClockMap
from drivers.errors import DeviceFault, RefusedError
from drivers.interfaces import ArmState, Vector

STEP = 0.02
"""Largest joint step in rad between two looks at a path."""
MARGIN = 1.001
"""What the speed between two looks may exceed that at them by; 5e-5 is the most seen over 600 random moves."""


class PointSpeed:
    """A bound `limit` in m/s on the speed of `points` (n, 3), m in the flange frame."""

    def __init__(self, kinematics: ArmKinematics, points: NDArray[np.float64], limit: float) -> None:
        self._kinematics = kinematics
        self._points = points
        self._limit = limit

    def fraction_speed(self, start: Joints, end: Joints) -> float:
        """How fast the straight joint way from `start` to `end` (6,) may be driven at most, in ways per second."""
        way = end - start
        count = int(np.ceil(np.abs(way).max() / STEP)) + 1
        twists = np.array(
            [self._kinematics.jacobian(start + part * way) @ way for part in np.linspace(0.0, 1.0, count + 1)]
        )
        speeds = twists[:, None, :3] + np.cross(twists[:, None, 3:], self._points)
        fastest = float(np.sqrt(np.max(np.sum(speeds**2, axis=2))))
        return self._limit / max(MARGIN * fastest, 1e-12)

    def excess(self, times: NDArray[np.float64], joints: NDArray[np.float64]) -> float:
        """Speed of the fastest point along the samples (n,) s and (n, 6) rad of a motion, over the limit."""
        placed = np.array([self._placed(row) for row in joints])
        ways = np.linalg.norm(np.diff(placed, axis=0), axis=2).max(axis=1)
        return float((ways / np.diff(times)).max() / self._limit)

    def _placed(self, joints: Joints) -> NDArray[np.float64]:
        flange = self._kinematics.fk(joints)
        placed: NDArray[np.float64] = self._points @ flange.rotation.T + flange.translation
        return placed


def carried_points(bodies: Sequence[Body]) -> NDArray[np.float64]:
    """The flange's origin and the corners of every body on the flange, (n, 3) m in the flange frame."""
    points = [np.zeros(3)]
    for body in bodies:
        if body.parent == FLANGE:
            half = 0.5 * np.array(body.size) + (body.radius or 0.0)
            points += [body.placement.act(np.array(signs) * half) for signs in product((-1.0, 1.0), repeat=3)]
    return np.array(points)


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
        return np.asarray(self.joints[0])

    @property
    def end(self) -> Joints:
        """Joint angles at the end."""
        return np.asarray(self.joints[-1])

    def at_pace(self, share: float) -> "Trajectory":
        """The same way at this share, up to 1, of its speed."""
        return Trajectory(self.times / share, self.joints)

    def speeds(self) -> NDArray[np.float64]:
        """(n - 1, 6) mean joint speeds between samples, rad/s."""
        return np.asarray(np.diff(self.joints, axis=0) / np.diff(self.times)[:, None])


@dataclass(frozen=True)
class LineLimits:
    """Limits of a straight line: speed m/s, acceleration m/s², jerk m/s³ and turning speed rad/s. The last `near` m of
    it, or its first when `leaving`, go at `near_speed` m/s at most."""

    speed: float = 0.25
    acceleration: float = 0.8
    jerk: float = 8.0
    turn_speed: float = 0.8
    near: float = 0.0
    near_speed: float = 0.25
    leaving: bool = False

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration", "jerk", "turn_speed", "near_speed"):
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
    kinematics: ArmKinematics, start: Joints, base_from_end: pin.SE3, line: LineLimits | None = None,
    period: float = PERIOD, points: PointSpeed | None = None,
) -> Trajectory:  # fmt: skip
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
        near = line.near / max(distance, line.near, 1e-9), min(speed, line.near_speed * speed / line.speed)
        times, fraction = _profile(speed, line.acceleration * scale, line.jerk * scale, period, near)
        if line.leaving:
            times, fraction = times[-1] - times[::-1], 1.0 - fraction[::-1]
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
    speed: float, acceleration: float, jerk: float, period: float, near: tuple[float, float] = (0.0, 1.0)
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ruckig's time-optimal way from 0 to 1, from rest to rest: times in s, about `period` apart, and positions. `near`
    is how much of it, at its end, goes at what speed at most, in ways per second."""
    for name, value in {"speed": speed, "acceleration": acceleration, "jerk": jerk, "period": period}.items():
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} {value} must be finite and greater than 0")
    last, slow = near
    if 0.0 < last < 1.0:
        before = _stretch((0.0, 0.0), (1.0 - last, slow), speed, acceleration, jerk)
        times, way = _sampled([before, _stretch((1.0 - last, slow), (1.0, 0.0), slow, acceleration, jerk)], period)
        # Where there is too little room to gain speed before, it would be gained by going back first.
        if np.diff(way).min() >= 0.0:
            return times, way
    return _sampled([_stretch((0.0, 0.0), (1.0, 0.0), slow if last else speed, acceleration, jerk)], period)


def _sampled(parts: Sequence[ruckig.Trajectory], period: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times, s, about `period` apart, and the positions then, of profiles that follow each other."""
    ends = np.cumsum([0.0, *(part.duration for part in parts)])
    times = np.linspace(0.0, ends[-1], max(1, int(np.ceil(ends[-1] / period - 1e-9))) + 1)
    which = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(parts) - 1)
    return times, np.array([parts[k].at_time(t - ends[k])[0][0] for k, t in zip(which, times, strict=True)])


def _stretch(
    begin: tuple[float, float], end: tuple[float, float], speed: float, acceleration: float, jerk: float
) -> ruckig.Trajectory:
    """Ruckig's way between two positions and speeds, at neither of which it speeds up."""
    request = ruckig.InputParameter(1)
    (request.current_position, request.current_velocity) = ([value] for value in begin)
    (request.target_position, request.target_velocity) = ([value] for value in end)
    request.max_velocity, request.max_acceleration, request.max_jerk = [speed], [acceleration], [jerk]
    profile = ruckig.Trajectory(1)
    result = ruckig.Ruckig(1).calculate(request, profile)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise RefusedError(
            f"no motion within speed {speed:g}, acceleration {acceleration:g} and jerk {jerk:g} (ways per s, s², s³): "
            f"Ruckig reports {result}"
        )
    return profile


LEAST_STATES = 10
LONGEST_GAP_S = 0.2
"""Between two states further apart than this the arm may have done anything."""
MOST_BEND_M = 2e-5
"""What a straight and even way between two states may be off by, by how the speed before and after differs from it."""


class FlangeTrack:
    """The poses base_from_flange of a motion by host time in s."""

    def __init__(
        self, name: str, states: Sequence[ArmState], clocks: ClockMap, longest_gap: float = LONGEST_GAP_S
    ) -> None:
        """`name` is the arm's, for errors: `DeviceFault` when there are too few states. `clocks` maps its clock to the
        host's; `longest_gap` is in s."""
        device = np.array([state.device_time for state in states])
        kept = np.flatnonzero(np.diff(device, prepend=-np.inf) > 0)
        self.name, self._longest_gap = name, longest_gap
        if len(kept) < LEAST_STATES:
            raise self._fault(f"only {len(kept)} states of the arm came during the motion, at least {LEAST_STATES}")
        self.times: Vector = np.array([clocks.host_time(time) for time in device[kept]])
        poses = [from_ur(states[int(k)].flange) for k in kept]
        self.translations: Vector = np.array([pose.translation for pose in poses])
        self._rotations = [pose.rotation for pose in poses]
        gaps = np.diff(self.times)
        speeds = np.diff(self.translations, axis=0) / gaps[:, None]
        change = np.linalg.norm(np.diff(speeds, axis=0), axis=1)
        self._bends = 0.25 * gaps * np.maximum(np.append(0.0, change), np.append(change, 0.0))

    def inside(self, times: Vector) -> NDArray[np.bool_]:
        """Which of the times (n,) lie between the first and the last state."""
        return np.asarray((times >= self.times[0]) & (times <= self.times[-1]))

    def even(self, times: Vector) -> NDArray[np.bool_]:
        """At which of the times (n,), which must be `inside`, the arm is known to have moved evenly. An arm that paused
        where no state came from it was not on the straight way between the two states around."""
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        return np.asarray(self._bends[after - 1] <= MOST_BEND_M)

    def at(self, times: Vector) -> Vector:
        """base_from_flange (n, 4, 4) at the times (n,), which must be `inside`. Straight and at an even turn between
        two states. Raises `DeviceFault` when those are too far apart."""
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        gaps = self.times[after] - self.times[after - 1]
        if len(gaps) and gaps.max() > self._longest_gap:
            raise self._fault(
                f"no state of the arm came for {gaps.max():.3f} s of the motion, allowed {self._longest_gap:g} s"
            )
        shares = (times - self.times[after - 1]) / gaps
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        for n, (k, share) in enumerate(zip(after, shares, strict=True)):
            before = self._rotations[k - 1]
            turn = pin.log3(before.T @ self._rotations[k])
            poses[n, :3, :3] = before @ pin.exp3(share * turn)
            poses[n, :3, 3] = (1 - share) * self.translations[k - 1] + share * self.translations[k]
        return poses

    def _fault(self, text: str) -> DeviceFault:
        return DeviceFault(
            self.name, "arm.states_lost", text, recoverable=True,
            hint="Look at the arm's link and at what else this machine is busy with.",
        )  # fmt: skip

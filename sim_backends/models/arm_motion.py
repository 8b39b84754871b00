"""Motions of the simulated arm: each plans from where the arm is and is stepped with time. Units: rad, m, s, N.

A motion changes `JointDrives.q` and `JointDrives.qd`; it knows nothing of safety, programs or bytes. Moves follow a
trapezoidal speed profile and end by themselves; streams go on until something replaces them.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from sim_backends.models.arm_kinematics import Kinematics, Matrix, Vector, invert, rotation_matrix, rotation_vector


class MotionError(Exception):
    """The motion cannot be carried out: no joint solution, a singularity, or a speed or acceleration of zero."""


@dataclass
class JointDrives:
    """The six joints and what a motion needs to know of the arm: joint angles, speeds, tool and felt wrench."""

    kinematics: Kinematics
    speed_limits: Vector
    q: Vector
    qd: Vector
    flange_from_tcp: Matrix = field(default_factory=lambda: np.eye(4))
    wrench: Vector = field(default_factory=lambda: np.zeros(6))
    speed_fraction: float = 1.0

    def base_from_tcp(self) -> Matrix:
        """Tool pose (4, 4) of the nominal kinematics."""
        pose: Matrix = self.kinematics.forward(self.q).dot(self.flange_from_tcp)
        return pose

    def tcp_jacobian(self) -> Matrix:
        """Jacobian (6, 6) of the tool point's velocity and rotation rate in base axes."""
        return self.tcp_state()[1]

    def tcp_state(self) -> tuple[Matrix, Matrix]:
        """base_from_flange (4, 4) and the Jacobian (6, 6) of the tool point."""
        pose, jacobian = self.kinematics.forward_with_jacobian(self.q)
        if self.flange_from_tcp[:3, 3].any():
            x, y, z = pose[:3, :3].dot(self.flange_from_tcp[:3, 3])
            jacobian[:3] += np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]).dot(jacobian[3:])
        return pose, jacobian

    def move_with(self, qd: Vector, dt: float) -> None:
        """Change to joint speeds `qd` evenly over `dt`."""
        self.q = self.q + (0.5 * dt) * (self.qd + qd)
        self.qd = qd


class Trapezoid:
    """Speed profile from rest to rest over `length` with at most `speed` and constant `acceleration`."""

    def __init__(self, length: float, speed: float, acceleration: float) -> None:
        if not (speed > 0 and acceleration > 0):
            raise MotionError(f"speed {speed:g} and acceleration {acceleration:g} of a move must be greater than 0")
        self.length = length
        self._acceleration = acceleration
        self._speed = min(speed, math.sqrt(length * acceleration))
        self._ramp = self._speed / acceleration
        self.duration = length / self._speed + self._ramp if length > 0 else 0.0

    def at(self, t: float) -> tuple[float, float]:
        """Distance and speed at time `t` since the start."""
        if t >= self.duration:
            return self.length, 0.0
        if t < self._ramp:
            return 0.5 * self._acceleration * t * t, self._acceleration * t
        left = self.duration - t
        if left < self._ramp:
            return self.length - 0.5 * self._acceleration * left * left, self._acceleration * left
        return self._speed * (t - 0.5 * self._ramp), self._speed


class SimulatedMotion(ABC):
    """One motion; `from_rest` ones have to begin with the arm standing, `feels_force` ones are stepped finely."""

    from_rest = False
    feels_force = False

    def begin(self, drive: JointDrives) -> None:  # noqa: B027  (most motions need no plan)
        """Plan from the present state; called again when the motion is resumed after a stop."""

    @abstractmethod
    def step(self, drive: JointDrives, dt: float) -> bool:
        """Advance by `dt` seconds; True once the motion has ended."""


class JointMove(SimulatedMotion):
    """Straight in joint space to `target` (6,) with all joints arriving together; `speed` is the leading joint's."""

    from_rest = True

    def __init__(self, target: Vector, speed: float, acceleration: float) -> None:
        self._target = target
        self._speed = speed
        self._acceleration = acceleration

    def begin(self, drive: JointDrives) -> None:
        """Plan the profile of the leading joint, slowed where another joint would exceed its limit."""
        self._start = drive.q
        self._way = self._target - drive.q
        lead = float(np.abs(self._way).max())
        self._time = 0.0
        speed = self._speed
        if lead > 0:
            speed = min(speed, float((drive.speed_limits * lead / np.maximum(np.abs(self._way), 1e-12)).min()))
        self._profile = Trapezoid(lead, speed, self._acceleration)

    def step(self, drive: JointDrives, dt: float) -> bool:
        """Advance along the profile."""
        self._time += dt * drive.speed_fraction
        if self._time >= self._profile.duration:
            drive.q = self._target
            drive.qd = np.zeros(6)
            return True
        distance, speed = self._profile.at(self._time)
        drive.q = self._start + self._way * (distance / self._profile.length)
        drive.qd = self._way * (speed * drive.speed_fraction / self._profile.length)
        return False


class LinearMove(SimulatedMotion):
    """Tool straight to `target` (4, 4) while turning about one axis.

    `speed` and `acceleration` bound translation in m/s, m/s² and rotation by the same numbers in rad/s, rad/s². One
    that `slows` goes along its line as fast as the joints can, where that is slower.
    """

    from_rest = True
    shape = "straight line"

    def __init__(self, target: Matrix, speed: float, acceleration: float, slows: bool = False) -> None:
        self._target = target
        self._speed = speed
        self._acceleration = acceleration
        self._slows = slows

    def begin(self, drive: JointDrives) -> None:
        """Plan the straight line from the present tool pose."""
        self._start = drive.base_from_tcp()
        self._way = self._target[:3, 3] - self._start[:3, 3]
        self._turn = rotation_vector(self._target[:3, :3].dot(self._start[:3, :3].T))
        self._tcp_from_flange = invert(drive.flange_from_tcp)
        self._time = 0.0
        lead = max(math.hypot(*self._way), math.hypot(*self._turn))
        self._profile = Trapezoid(lead, self._speed, self._acceleration)

    def step(self, drive: JointDrives, dt: float) -> bool:
        """Advance along the line and solve the joints for it; MotionError where they cannot follow."""
        step = dt * drive.speed_fraction
        q = self._joints(drive, self._time + step, dt)
        while self._slows and (excess := float((np.abs(q - drive.q) / drive.speed_limits).max()) / dt) > 1.0:
            step *= 0.99 / excess
            q = self._joints(drive, self._time + step, dt)
        self._time += step
        done = self._time >= self._profile.duration
        drive.qd = np.zeros(6) if done else (q - drive.q) / dt
        drive.q = q
        return done

    def _joints(self, drive: JointDrives, time: float, dt: float) -> Vector:
        distance, _ = self._profile.at(time)
        fraction = distance / self._profile.length if self._profile.length > 0 else 1.0
        q = drive.kinematics.refine(self._pose(fraction).dot(self._tcp_from_flange), drive.q + dt * drive.qd)
        if q is None:
            raise MotionError(f"the {self.shape} leaves the reach of the arm or passes a singularity")
        return q

    def _pose(self, fraction: float) -> Matrix:
        """Tool pose (4, 4) after this much of the way."""
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(self._turn * fraction).dot(self._start[:3, :3])
        pose[:3, 3] = self._start[:3, 3] + self._way * fraction
        return pose


class StopMotion(SimulatedMotion):
    """Brake along the present direction: `rate` is of the leading joint in rad/s², or of the tool in m/s²."""

    def __init__(self, rate: float, linear: bool = False) -> None:
        self._rate = max(rate, 0.1)
        self._linear = linear

    def begin(self, drive: JointDrives) -> None:
        """Take the present speed as the one to be braked."""
        self._from = drive.qd
        if self._linear:
            twist = drive.tcp_jacobian().dot(drive.qd)
            speed = max(math.hypot(*twist[:3]), math.hypot(*twist[3:]))
        else:
            speed = float(np.abs(drive.qd).max())
        self._duration = speed / self._rate
        self._time = 0.0

    def step(self, drive: JointDrives, dt: float) -> bool:
        """Brake."""
        left = max(0.0, min(dt, self._duration - self._time))
        self._time += dt
        if self._time >= self._duration:
            drive.q = drive.q + (0.5 * left) * drive.qd
            drive.qd = np.zeros(6)
            return True
        drive.move_with(self._from * (1.0 - self._time / self._duration), dt)
        return False


class ArcMove(LinearMove):
    """Tool on the circle from where it stands past `via` (3,) to `target` (4, 4), turning evenly to the target's
    orientation or, when `fixed`, with the circle."""

    shape = "circle"

    def __init__(self, via: Vector, target: Matrix, speed: float, acceleration: float, fixed: bool = False) -> None:
        super().__init__(target, speed, acceleration, slows=True)
        self._via = via
        self._fixed = fixed
        self._axis: Vector | None = None

    def begin(self, drive: JointDrives) -> None:
        """Find the circle, or go on along it; MotionError when the three points lie on a line."""
        super().begin(drive)
        here = self._start[:3, 3]
        if self._axis is None:
            self._centre, self._axis = self._circle(here)
        self._first, last = here - self._centre, self._target[:3, 3] - self._centre
        sine, cosine = float(self._axis.dot(np.cross(self._first, last))), float(self._first.dot(last))
        self._angle = math.atan2(sine, cosine) % (2.0 * math.pi)
        # A stop in between may have left the circle a little.
        self._off = last - rotation_matrix(self._axis * self._angle).dot(self._first)
        turn = 0.0 if self._fixed else math.hypot(*self._turn)
        self._profile = Trapezoid(max(self._angle * math.hypot(*self._first), turn), self._speed, self._acceleration)

    def _circle(self, here: Vector) -> tuple[Vector, Vector]:
        """Its centre (3,) and the axis (3,) that it is gone round."""
        past, whole = self._via - here, self._way
        normal = np.cross(past, whole)
        size = float(normal.dot(normal))
        if size < 1e-9 * float(past.dot(past)) * float(whole.dot(whole)) or size == 0.0:
            raise MotionError("the start, the via point and the end of a circle lie on a line")
        arm = whole.dot(whole) * np.cross(normal, past) + past.dot(past) * np.cross(whole, normal)
        return here + arm / (2.0 * size), normal / math.sqrt(size)

    def _pose(self, fraction: float) -> Matrix:
        assert self._axis is not None
        pose = np.eye(4)
        along = rotation_matrix(self._axis * (self._angle * fraction))
        turn = along if self._fixed else rotation_matrix(self._turn * fraction)
        pose[:3, :3] = turn.dot(self._start[:3, :3])
        pose[:3, 3] = self._centre + along.dot(self._first) + fraction * self._off
        return pose


_FORCE_GAIN = np.array([2e-3, 2e-3, 2e-3, 2e-2, 2e-2, 2e-2])
"""Speed per force error of force mode: m/s per N, rad/s per N·m; stable against 1e5 N/m at 4 ms steps."""


class Servo(SimulatedMotion):
    """Follow a streamed joint target (6,) like a critically damped second-order system that lags a ramp by `lag` s."""

    def __init__(self, target: Vector, lag: float) -> None:
        self.target = target
        self.lag = lag

    def step(self, drive: JointDrives, dt: float) -> bool:
        """Exact solution over `dt` for a target that stays: stable for any step."""
        rate = 2.0 / self.lag
        error = drive.q - self.target
        slope = drive.qd + rate * error
        decay = math.exp(-rate * dt)
        error = (error + slope * dt) * decay
        speed = slope * decay - rate * error
        if max(np.abs(error).max(), np.abs(speed).max()) < 1e-9:
            error, speed = np.zeros(6), np.zeros(6)
        drive.q = self.target + error
        drive.qd = speed
        return False


class JointSpeed(SimulatedMotion):
    """Change to joint speeds `target` (6,) rad/s with `acceleration` rad/s² of the leading joint and keep them."""

    def __init__(self, target: Vector, acceleration: float) -> None:
        self.target = target
        self.acceleration = acceleration

    def step(self, drive: JointDrives, dt: float) -> bool:
        """Ramp, then cruise."""
        drive.move_with(_ramped(drive.qd, self.target, self.acceleration * dt), dt)
        return False


class LinearSpeed(SimulatedMotion):
    """Change to tool velocity `target` (6,) m/s, rad/s in base axes with `acceleration` and keep it."""

    def __init__(self, target: Vector, acceleration: float) -> None:
        self.target = target
        self.acceleration = acceleration

    def begin(self, drive: JointDrives) -> None:
        """Take over the present tool velocity."""
        self._twist = drive.tcp_jacobian().dot(drive.qd)

    def step(self, drive: JointDrives, dt: float) -> bool:
        """Ramp, then cruise; near a singularity the joint speeds grow until the arm's limits stop it."""
        self._twist = _ramped(self._twist, self.target, self.acceleration * dt)
        drive.move_with(_joint_speeds(drive, self._twist), dt)
        return False


class ForceMode(SimulatedMotion):
    """Compliant along selected axes of `task` (4, 4): moves until the tool presses with `wrench` (6,) there.
    `selection` (6,) is 1 for compliant axes, which move at most with `limits` (6,) m/s, rad/s; the others hold."""

    feels_force = True

    def __init__(self, task: Matrix, selection: Vector, wrench: Vector, limits: Vector) -> None:
        self.task = task
        self.selection = selection
        self.wrench = wrench
        self.limits = limits

    def step(self, drive: JointDrives, dt: float) -> bool:
        """Admittance: speed proportional to the difference of wanted and felt force."""
        turn = self.task[:3, :3]
        felt = np.concatenate((turn.T.dot(drive.wrench[:3]), turn.T.dot(drive.wrench[3:])))
        speed = np.clip(_FORCE_GAIN * (self.wrench + felt), -self.limits, self.limits) * self.selection
        drive.move_with(_joint_speeds(drive, np.concatenate((turn.dot(speed[:3]), turn.dot(speed[3:])))), dt)
        return False


def _ramped(now: Vector, target: Vector, change: float) -> Vector:
    """`now` moved towards `target`, its leading component by at most `change`."""
    difference = target - now
    lead = float(np.abs(difference).max())
    return target.copy() if lead <= change else now + difference * (change / lead)


def _joint_speeds(drive: JointDrives, twist: Vector) -> Vector:
    try:
        speeds: Vector = np.asarray(np.linalg.solve(drive.tcp_jacobian(), twist), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise MotionError("the arm stands in a singularity") from error
    return speeds

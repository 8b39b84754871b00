"""Motions of the simulated arm that end by themselves: each plans from where the arm is and is stepped with time.

A motion changes `JointDrives.q` and `JointDrives.qd`; it knows nothing of safety, programs or bytes. Moves follow a
trapezoidal speed profile. Motions that are streamed are in `arm_streams`. Units: rad, m, s, N.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from sim_backends.models.arm_kinematics import (
    Kinematics,
    Matrix,
    Vector,
    invert,
    rotation_matrix,
    rotation_vector,
)


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
        """The joint angles at `time` of the profile, `dt` from now."""
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

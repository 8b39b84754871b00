"""Motions of the simulated arm that go on until something else replaces them: servo targets, speeds, compliance.

Units: rad, m, s, N.
"""

from __future__ import annotations

import math

import numpy as np

from sim_backends.models.arm_kinematics import Matrix, Vector
from sim_backends.models.arm_motion import JointDrives, MotionError, SimulatedMotion

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

    `selection` (6,) is 1 for compliant axes, which move at most with `limits` (6,) m/s, rad/s; the others hold.
    """

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

"""Motions of the arm: a joint trajectory that can be sampled at any time, and the motion as its caller holds it.

What an arm may be asked to do, and the checks before anything is sent. Defaults are those of a UR10e."""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.arm.faults import fault
from drivers.arm.feed import Six, StreamTiming
from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceError, LimitError, check_positive, check_range, shown
from drivers.interfaces import Vector

_WALL_MARGIN_S = 0.5


class UrMotion:
    """A motion that was started; `contact` tells whether it ended at its force limit.

    `pace` tells how regularly the points of a trajectory went out, once it has ended; None of other motions.
    """

    def __init__(self, device: str, what: str, number: int, clock: Clock, stop: Callable[[], None]) -> None:
        self.contact = False
        self.pace: StreamTiming | None = None
        self.number = number
        self._device = device
        self._what = what
        self._clock = clock
        self._stop = stop
        self._ended = threading.Event()
        self._error: Exception | None = None

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        return self._ended.is_set()

    def wait(self, timeout: float) -> None:
        """Block until the arm stands at the motion's end, at most `timeout` s of the clock.

        With a clock that runs faster than the wall the wire's own time is allowed on top. Raises `DeadlineError` (the
        arm is then stopped), `DeviceFault`, or `Aborted` when a stop ended the motion.
        """
        margin = _WALL_MARGIN_S * max(0.0, self._clock.rate - 1.0)
        if not self._clock.wait(self._ended, timeout + margin):
            late = f"{self._what} did not end within {timeout:g} s"
            try:
                self._stop()
            except DeviceError as error:
                told = f"{late}, and the stop was not confirmed: {error}. Press the emergency stop."
                raise DeadlineError(self._device, told) from error
            raise DeadlineError(self._device, f"{late} and was stopped. Allow more time or move faster.")
        if self._error is not None:
            raise self._error

    def end(self, how: str, text: str = "") -> None:
        """Note how the motion ended: arrived, contact, stopped or a fault's code."""
        if how == "stopped":
            self.fail(Aborted(f"{self._device}: {self._what} was stopped before its end"))
        elif how in ("arrived", "contact"):
            self.contact = how == "contact"
            self._ended.set()
        else:
            self.fail(fault(self._device, how, text))

    def fail(self, error: Exception) -> None:
        """Note that the motion ended with an error; the first one counts."""
        if not self._ended.is_set():
            self._error = error
            self._ended.set()


class JointTrajectory:
    """Joint angles over time, straight lines between the given points; `times` begin at 0 and increase."""

    def __init__(self, times: list[float], joints: list[Six]) -> None:
        self._times = times
        self._joints = joints
        self.duration = times[-1]
        self.end = joints[-1]

    def at(self, time: float) -> Six:
        """Joint angles at `time`, those of the nearer end outside the trajectory."""
        if time <= 0.0:
            return self._joints[0]
        if time >= self.duration:
            return self.end
        after = bisect_right(self._times, time)
        begin, end = self._times[after - 1], self._times[after]
        part = (time - begin) / (end - begin)
        before = self._joints[after - 1]
        return tuple(a + part * (b - a) for a, b in zip(before, self._joints[after], strict=True))

    def speed_at(self, time: float) -> float:
        """Speed of the leading joint at `time`, rad/s; 0 outside the trajectory."""
        if not 0.0 <= time < self.duration:
            return 0.0
        after = bisect_right(self._times, time)
        way = largest_difference(self._joints[after - 1], self._joints[after])
        return way / (self._times[after] - self._times[after - 1])


def largest_difference(a: Six, b: Six) -> float:
    """The largest absolute difference of two sets of joint angles."""
    return max(abs(x - y) for x, y in zip(a, b, strict=True))


def pose_difference(a: Six, b: Six) -> tuple[float, float]:
    """Distance in m and angle in rad between two poses (x, y, z, rotation vector)."""
    cosine = abs(sum(x * y for x, y in zip(_quaternion(a[3:]), _quaternion(b[3:]), strict=True)))
    return math.dist(a[:3], b[:3]), 2.0 * math.acos(min(1.0, cosine))


def _quaternion(vector: Six) -> Six:
    angle = math.hypot(*vector)
    if angle < 1e-12:
        return (1.0, 0.0, 0.0, 0.0)
    scale = math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), *(scale * v for v in vector))


_TURN = 2 * math.pi


@dataclass(frozen=True)
class ArmLimits:
    """Limits in SI units: `joints` (low, high) and `joint_speeds` per joint, in rad and rad/s.

    `joint_acceleration` rad/s², `linear_speed` m/s and `linear_acceleration` m/s² of the flange, `reach` m of the
    flange from the base's origin, `payload` kg.
    """

    joints: tuple[tuple[float, float], ...] = ((-_TURN, _TURN),) * 6
    joint_speeds: tuple[float, ...] = tuple(math.radians(v) for v in (120, 120, 180, 180, 180, 180))
    joint_acceleration: float = 8.0
    linear_speed: float = 1.0
    linear_acceleration: float = 5.0
    reach: float = 1.45
    payload: float = 12.5

    def check_joints(self, device: str, joints: Vector) -> Vector:
        """The joint angles (6,) in rad if all are inside the limits, else `LimitError`."""
        joints = _six(device, "joint angles", joints)
        for index, (angle, (low, high)) in enumerate(zip(joints, self.joints, strict=True)):
            check_range(device, f"angle of joint {index + 1}", angle, low=low, high=high, unit="rad")
        return joints

    def check_pose(self, device: str, flange: Vector) -> Vector:
        """The flange pose (6,) if its place is within reach, else `LimitError`."""
        flange = _six(device, "flange pose", flange)
        check_range(
            device, "distance of the flange from the base", float(np.linalg.norm(flange[:3])), 0, self.reach, unit="m"
        )
        return flange

    def check_joint_move(self, device: str, speed: float, acceleration: float) -> None:
        """`LimitError` unless speed (rad/s of the leading joint) and acceleration (rad/s²) are allowed."""
        check_positive(device, "joint speed", speed, max(self.joint_speeds), "rad/s")
        check_positive(device, "joint acceleration", acceleration, self.joint_acceleration, "rad/s^2")

    def check_linear_move(self, device: str, speed: float, acceleration: float) -> None:
        """`LimitError` unless speed (m/s) and acceleration (m/s²) of the flange are allowed."""
        check_positive(device, "flange speed", speed, self.linear_speed, "m/s")
        check_positive(device, "flange acceleration", acceleration, self.linear_acceleration, "m/s^2")

    def check_payload(self, device: str, mass: float, centre: Vector) -> tuple[float, tuple[float, float, float]]:
        """Mass in kg and centre of gravity (3,) in m if the arm may carry it, else `LimitError`."""
        mass = check_range(device, "payload", mass, low=0.0, high=self.payload, unit="kg")
        x, y, z = (check_range(device, "payload offset", float(v), low=-0.5, high=0.5, unit="m") for v in centre)
        return mass, (x, y, z)

    def check_trajectory(self, device: str, times: Vector, joints: Vector) -> tuple[Vector, Vector]:
        """Times (n,) s and joints (n, 6) rad if they are in order, inside the limits and nowhere too fast.

        Raises `LimitError` that names the point.
        """
        times, joints = np.asarray(times, dtype=float), np.asarray(joints, dtype=float)
        if times.ndim != 1 or len(times) < 2 or joints.shape != (len(times), 6):
            raise LimitError(
                device,
                f"a trajectory needs at least 2 times (n,) and joints (n, 6); got {times.shape} and {joints.shape}",
            )
        if not (np.isfinite(times).all() and np.isfinite(joints).all()):
            raise LimitError(device, "the trajectory holds values that are not finite; nothing was sent")
        if times[0] != 0.0 or (np.diff(times) <= 0).any():
            raise LimitError(device, "the trajectory's times must begin at 0 s and increase; nothing was sent")
        for index, (low, high) in enumerate(self.joints):
            what = f"angle of joint {index + 1} on the trajectory"
            check_range(device, what, float(joints[:, index].min()), low=low, high=high, unit="rad")
            check_range(device, what, float(joints[:, index].max()), low=low, high=high, unit="rad")
        speeds = np.abs(np.diff(joints, axis=0)) / np.diff(times)[:, None]
        point, joint = np.unravel_index(int(np.argmax(speeds / np.array(self.joint_speeds))), speeds.shape)
        if speeds[point, joint] > self.joint_speeds[joint] * (1 + 1e-9):
            raise LimitError(
                device,
                f"joint {joint + 1} would turn at {shown(float(speeds[point, joint]), 'rad/s')} at "
                f"{times[point]:.3f} s, allowed up to {shown(self.joint_speeds[joint], 'rad/s')}; nothing was sent. "
                "Plan the trajectory slower.",
            )
        return times, joints


def _six(device: str, what: str, values: Vector) -> Vector:
    array = np.asarray(values, dtype=float)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise LimitError(device, f"{what} must be 6 finite numbers, got {array.tolist()}; nothing was sent")
    return array

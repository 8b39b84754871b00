"""Motions of the arm: a joint trajectory that can be sampled at any time, and the motion as its caller holds it."""

import math
import threading
from bisect import bisect_right
from collections.abc import Callable

from drivers.arm.faults import fault
from drivers.arm.feed import Six, StreamTiming
from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceError

_WALL_MARGIN_S = 0.5


class UrMotion:
    """A motion that was started; `contact` tells whether it ended at its force limit. `pace` tells how regularly the
    points of a trajectory went out, once it has ended; None of other motions."""

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

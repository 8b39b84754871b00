"""A joint trajectory that can be sampled at any time, and the distance between poses; plain Python, for the child."""

from __future__ import annotations

import math
from bisect import bisect_right

from drivers.arm.messages import Six


class Trajectory:
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

"""The world's clock, N times as fast as the wall, and the recent past of moving bodies and of switches.

Devices' protocols keep their wall rates; physics, time stamps and exposures are in world seconds. Cameras expose
between two ticks of the physics and are rendered later: poses are interpolated. Before the first and after the last
sample the nearest pose holds.
"""

import math
import threading
import time
from bisect import bisect_right
from collections import deque

import numpy as np
from numpy.typing import NDArray


class WorldClock:
    """World time in seconds since the world began, `speed` world seconds per wall second."""

    def __init__(self, speed: float = 1.0) -> None:
        """Start at zero. Raises ValueError unless `speed` is finite and greater than 0."""
        if not 0.0 < speed < float("inf"):
            raise ValueError(f"world speed {speed} must be a finite number greater than 0")
        self.speed = float(speed)
        self._origin = time.monotonic()

    def now(self) -> float:
        """World seconds since this clock was made."""
        return (time.monotonic() - self._origin) * self.speed

    def sleep(self, seconds: float) -> None:
        """Wait `seconds` of world time; a value that is not positive returns at once."""
        if seconds > 0:
            time.sleep(seconds / self.speed)

    def sleep_until(self, t: float) -> None:
        """Wait until world time `t`; a time in the past returns at once."""
        self.sleep(t - self.now())

    def wall(self, seconds: float) -> float:
        """The wall seconds that `seconds` of world time take, for time-outs of blocking system calls."""
        return seconds / self.speed


class SteppedClock(WorldClock):
    """World time that stands still until it is told to go on: for worlds that one program steps by itself."""

    def __init__(self) -> None:
        """Start at zero."""
        super().__init__()
        self._time = 0.0

    def now(self) -> float:
        """World seconds as far as they were stepped."""
        return self._time

    def step_to(self, t: float) -> None:
        """Let it be world time `t`. Raises ValueError when that is in the past."""
        if t < self._time:
            raise ValueError(f"world time {t} s lies before {self._time} s: time does not run backwards")
        self._time = t

    def sleep(self, seconds: float) -> None:
        """Step `seconds` on; a value that is not positive changes nothing."""
        if seconds > 0:
            self._time += seconds


Pose = NDArray[np.float64]
"""(4, 4) homogeneous transformation, metres."""


class History:
    """Poses of one body over the last `keep` world seconds; safe between threads."""

    def __init__(self, keep: float = 15.0) -> None:
        self._keep = keep
        self._samples: deque[tuple[float, Pose]] = deque()
        self._lock = threading.Lock()

    def append(self, t: float, pose: Pose) -> None:
        """Remember `pose` (4, 4) at world time `t`; a time that is not later than the last one replaces its pose."""
        sample = (t, np.array(pose, dtype=np.float64))
        with self._lock:
            while self._samples and self._samples[-1][0] >= t:
                self._samples.pop()
            self._samples.append(sample)
            while self._samples[0][0] < t - self._keep:
                self._samples.popleft()

    def at(self, t: float) -> Pose:
        """The pose (4, 4) at world time `t`: translation linear, rotation at constant rate about one axis. Raises
        LookupError while nothing has been remembered."""
        with self._lock:
            if not self._samples:
                raise LookupError("the history is empty: append a pose before reading one")
            before, after = self._around(t)
        if before is after:
            return before[1].copy()
        return interpolate(before[1], after[1], (t - before[0]) / (after[0] - before[0]))

    def _around(self, t: float) -> tuple[tuple[float, Pose], tuple[float, Pose]]:
        # Readers ask for the latest few milliseconds, and a deque is fast at its ends only.
        if t >= self._samples[-1][0]:
            return self._samples[-1], self._samples[-1]
        if t <= self._samples[0][0]:
            return self._samples[0], self._samples[0]
        later = self._samples[-1]
        for steps, earlier in enumerate(reversed(self._samples)):
            if earlier[0] <= t:
                return earlier, later
            later = earlier
            if steps > 100:
                break
        samples = list(self._samples)
        i = bisect_right(samples, t, key=lambda sample: sample[0])
        return samples[i - 1], samples[i]


def interpolate(a: Pose, b: Pose, fraction: float) -> Pose:
    """The pose (4, 4) at `fraction` (0…1) of the way from `a` to `b`; exact for small rotations, good to π/2."""
    pose = np.eye(4)
    pose[:3, 3] = a[:3, 3] + fraction * (b[:3, 3] - a[:3, 3])
    pose[:3, :3] = a[:3, :3] @ _turn(a[:3, :3].T @ b[:3, :3], fraction)
    return pose


def _turn(rotation: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """The rotation (3, 3) by `fraction` of the angle of `rotation` about its own axis (Rodrigues)."""
    r = rotation
    axis = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = math.sqrt(float(axis @ axis))
    if sine < 1e-12:
        return np.eye(3)
    angle = fraction * math.atan2(sine, 0.5 * (float(np.trace(r)) - 1.0))
    x, y, z = axis / sine
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: NDArray[np.float64] = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return turned


class SwitchHistory:
    """When a switch was on: its changes over the last `keep` world seconds; safe between threads."""

    def __init__(self, on: bool = False, keep: float = 30.0) -> None:
        self._keep = keep
        self._changes: list[tuple[float, bool]] = [(float("-inf"), on)]
        self._lock = threading.Lock()

    def record(self, t: float, on: bool) -> None:
        """Note the switch's state at world time `t`, which must not go back."""
        with self._lock:
            if on == self._changes[-1][1]:
                return
            self._changes.append((t, on))
            first = bisect_right(self._changes, t - self._keep, key=lambda change: change[0])
            del self._changes[: max(0, first - 1)]

    def at(self, t: float) -> bool:
        """Whether it was on at world time `t`."""
        with self._lock:
            return self._changes[max(0, bisect_right(self._changes, t, key=lambda change: change[0]) - 1)][1]

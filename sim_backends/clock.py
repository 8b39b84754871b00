"""The world's clock: seconds of the simulated world, running N times as fast as the wall.

Devices' protocols keep their wall rates; physics, time stamps and exposures are in world seconds.
"""

from __future__ import annotations

import time


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

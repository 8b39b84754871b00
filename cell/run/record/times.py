"""The times of a record: nanoseconds since the epoch on the wall's clock, the cell's own on the virtual one."""

from __future__ import annotations

import math
import time

from drivers.clock import Clock
from statemachine.waiting import WaitableClock


class Times:
    """Turns the times that others tell into those of a record; all in ns."""

    def __init__(self, clock: Clock) -> None:
        self.virtual = isinstance(clock, WaitableClock)
        self.name = "virtual" if self.virtual else "wall"
        self._clock = clock
        self._begun, self._epoch = clock.now(), time.time_ns()

    def now(self) -> int:
        """Now."""
        return self.of(self._clock.now())

    def of(self, host_time: float) -> int:
        """A time of the cell's clock, in s; one that nobody knows is now."""
        if not math.isfinite(host_time):
            host_time = self._clock.now()
        if self.virtual:
            return max(0, round(1e9 * host_time))
        return self._epoch + round(1e9 * self._clock.wall(host_time - self._begun))

    def of_wall(self, seconds: float) -> int:
        """A time since the epoch, in s, that was taken just now."""
        return self.now() if self.virtual else round(1e9 * seconds)

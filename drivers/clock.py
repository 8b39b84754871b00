"""The host's clock, through which all waiting goes, so that a simulated cell can run faster than the wall.

The way from a device's clock to the host's, from latched device times and their round trips.

The device latched at some instant within the round trip, so half of it bounds the error of its middle. Of several
latches the shortest is kept; latches far apart show how fast the device's clock runs. A clock that was set meanwhile,
by a restart or by a time service, contradicts its earlier latches: they are forgotten."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


class Clock:
    """Host time in seconds, running `rate` times as fast as the wall.

    With real devices the rate is 1. A simulated cell that runs N times faster than the wall is driven with rate N:
    deadlines, periods and time stamps then all stay in the cell's own seconds.
    """

    def __init__(self, rate: float = 1.0) -> None:
        if not rate > 0:
            raise ValueError(f"clock rate {rate} must be greater than 0")
        self.rate = rate
        self._origin = time.monotonic()

    def now(self) -> float:
        """Seconds since this clock was made."""
        return (time.monotonic() - self._origin) * self.rate

    def sleep(self, seconds: float) -> None:
        """Wait `seconds` of this clock; a value that is not positive returns at once."""
        if seconds > 0:
            time.sleep(seconds / self.rate)

    def sleep_until(self, deadline: float) -> None:
        """Wait until `now()` reaches `deadline`; a deadline in the past returns at once."""
        self.sleep(deadline - self.now())

    def wait(self, event: threading.Event, timeout: float) -> bool:
        """Wait for `event` for at most `timeout` seconds of this clock; True when it was set."""
        return event.wait(min(max(0.0, timeout) / self.rate, threading.TIMEOUT_MAX))

    def wall(self, seconds: float) -> float:
        """The seconds on the wall that `seconds` of this clock take, for time-outs of blocking system calls."""
        return seconds / self.rate

    @contextmanager
    def alarm(self, seconds: float, ring: Callable[[], float | None]) -> Iterator[None]:
        """Inside this context call `ring()` after `seconds`, whatever this thread does meanwhile. `ring` gives in how
        many seconds to call it again, or None; it is called by another thread."""
        over = threading.Event()

        def watch() -> None:
            left: float | None = seconds
            while left is not None and not self.wait(over, left):
                left = ring()

        watcher = threading.Thread(target=watch, name="alarm", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()


MAX_DRIFT = 100e-6
"""A crystal's drift that is expected before it has been measured."""
STEADY_DRIFT = 5e-6
"""By so much a crystal's rate changes as it warms up, however long it has been measured."""
_KEEP = 64


WALL_FLOOR_S = 0.5


def timeout_of(clock: Clock, seconds: float) -> float:
    """`seconds` of the clock, or half a second of the wall where that is longer."""
    return max(seconds, WALL_FLOOR_S * clock.rate)


@dataclass(frozen=True)
class Latch:
    """The device read `device` s somewhere between the host times `before` and `after`, s."""

    before: float
    device: float
    after: float

    @property
    def host(self) -> float:
        """Middle of the round trip, s."""
        return 0.5 * (self.before + self.after)

    @property
    def bound(self) -> float:
        """Largest possible error of `host`, s."""
        return 0.5 * (self.after - self.before)


class ClockMap:
    """Maps device times to host times; empty until the first `add`."""

    def __init__(self) -> None:
        self._latches: deque[Latch] = deque(maxlen=_KEEP)
        self._best: Latch | None = None
        self._rate = 1.0
        self._drift = MAX_DRIFT

    def add(self, latches: Iterable[Latch]) -> None:
        """Take the latches of one moment, of which the shortest round trip counts."""
        newest = min(latches, key=lambda latch: latch.bound)
        if self._best is not None and not self._continues(newest):
            self._latches.clear()
            self._rate, self._drift = 1.0, MAX_DRIFT
        self._latches.append(newest)
        oldest = self._latches[0]
        span = newest.device - oldest.device
        if span > 0.0 and (uncertainty := (newest.bound + oldest.bound) / span) < MAX_DRIFT:
            self._rate = (newest.host - oldest.host) / span
            self._drift = max(uncertainty, STEADY_DRIFT)
        self._best = min(self._latches, key=lambda latch: latch.bound + self._drift * (newest.host - latch.host))
        self._newest = newest

    def _continues(self, latch: Latch) -> bool:
        """Whether the clock may have run on evenly from the earlier latches to this one."""
        return abs(self.host_time(latch.device) - latch.host) <= self.bound_at(latch.host) + latch.bound

    def host_time(self, device: float) -> float:
        """Host time in s at which the device's clock read `device` s."""
        if self._best is None:
            raise ValueError("the clocks have not been compared yet")
        return self._best.host + self._rate * (device - self._best.device)

    @property
    def uncertainty(self) -> float:
        """Bound in s on the error of `host_time` near the newest latch."""
        return self.bound_at(self._newest.host)

    def bound_at(self, host: float) -> float:
        """Bound in s on the error of `host_time` near the host time `host`, s."""
        if self._best is None:
            raise ValueError("the clocks have not been compared yet")
        return self._best.bound + self._drift * abs(host - self._best.host)

    @property
    def drift(self) -> float:
        """Host seconds per device second, less one."""
        return self._rate - 1.0

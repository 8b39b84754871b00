"""The host's clock, through which all waiting goes, so that a simulated cell can run faster than the wall."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


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
        return event.wait(max(0.0, timeout) / self.rate)

    def wall(self, seconds: float) -> float:
        """The seconds on the wall that `seconds` of this clock take, for time-outs of blocking system calls."""
        return seconds / self.rate

    @contextmanager
    def alarm(self, seconds: float, ring: Callable[[], float | None]) -> Iterator[None]:
        """Inside this context call `ring()` after `seconds`, whatever this thread does meanwhile.

        `ring` gives in how many seconds to call it again, or None; it is called by another thread.
        """
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

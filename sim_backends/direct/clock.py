"""The virtual clock: it stands still until somebody waits on it, and then lets the world go on at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.clock import Clock
from sim_backends.clock import SteppedClock

Look = Callable[[], None]
Ring = Callable[[], float | None]


class VirtualClock(Clock):
    """World time as the host's clock, at rate 1: whoever waits on it lets the world's time pass, tick by tick.

    One thread moves the time at a time. A thread that looks around while it waits does so after each tick of its own.
    """

    def __init__(self, time: SteppedClock, tick: Callable[[float], None]) -> None:
        """`tick(until)` lets the world go on by one tick, at most to `until` s."""
        super().__init__()
        self._time = time
        self._tick = tick
        self._moving = threading.Lock()
        self._looking = threading.local()
        self._alarms: dict[Ring, float] = {}

    def now(self) -> float:
        """World time in s."""
        return self._time.now()

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of the world pass. Raises what the look-out of this thread raises (see `looking`)."""
        until = self.now() + seconds
        while self._step(until):
            self.look()

    def wait(self, event: threading.Event, timeout: float) -> bool:
        """Let time pass until `event` is set, at most `timeout` s; True when it was set."""
        until = self.now() + timeout
        while not event.is_set() and self._step(until):
            self.look()
        return event.is_set()

    @contextmanager
    def looking(self, look: Look) -> Iterator[None]:
        """Inside this context `look()` is called after each tick that this thread waits for, in place of an outer one.

        What it raises comes out of the wait.
        """
        outer = getattr(self._looking, "look", None)
        self._looking.look = look
        try:
            yield
        finally:
            self._looking.look = outer

    def look(self) -> None:
        """Look around now, if this thread does that at all."""
        look: Look | None = getattr(self._looking, "look", None)
        if look is not None:
            look()

    def _step(self, until: float) -> bool:
        with self._moving:
            if self._time.now() >= until:
                return False
            self._tick(until)
        self._ring()
        return True

    @contextmanager
    def alarm(self, seconds: float, ring: Ring) -> Iterator[None]:
        """See `Clock.alarm`; rung by whoever lets the time pass, after the tick that brings it there."""
        self._alarms[ring] = self.now() + seconds
        try:
            yield
        finally:
            self._alarms.pop(ring, None)

    def _ring(self) -> None:
        for ring in [ring for ring, due in self._alarms.items() if due <= self._time.now()]:
            self._alarms.pop(ring, None)
            if (again := ring()) is not None:
                self._alarms[ring] = self.now() + again

"""The newest state of the arm, and waiting for one that is fresh or that shows something."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.arm.messages import Snapshot
from drivers.clock import Clock
from drivers.errors import DeadlineError
from drivers.interfaces import LinkStatistics
from drivers.quantities import shown

_FLOOR_S, _FLOOR_FAST_S = 0.5, 3.0


class StateFeed:
    """Snapshots as they come in; `lost` says whether the link is, and `alive` raises the fault of that."""

    def __init__(
        self,
        name: str,
        clock: Clock,
        lost: Callable[[], bool],
        alive: Callable[[], None],
        statistics: LinkStatistics,
    ) -> None:
        self._name = name
        self._clock = clock
        self._lost = lost
        self._alive = alive
        self._statistics = statistics
        self._news = threading.Condition()
        self._snapshot: Snapshot | None = None
        self._listeners: list[Callable[[Snapshot], None]] = []

    def take(self, snapshot: Snapshot) -> None:
        """A new snapshot has come."""
        with self._news:
            self._snapshot = snapshot
            for listener in self._listeners:
                listener(snapshot)
            self._news.notify_all()

    @contextmanager
    def listening(self, listener: Callable[[Snapshot], None]) -> Iterator[None]:
        """`listener` is told every snapshot that comes while the context is open, in order, by the link's thread."""
        with self._news:
            self._listeners = [*self._listeners, listener]
        try:
            yield
        finally:
            with self._news:
                self._listeners = [kept for kept in self._listeners if kept is not listener]

    def forget(self) -> None:
        """What was seen before a new link says nothing any more."""
        with self._news:
            self._snapshot = None

    def wake(self) -> None:
        """Let everybody who waits look whether the link is lost."""
        with self._news:
            self._news.notify_all()

    def fresh(self, max_age: float) -> tuple[Snapshot, float]:
        """The newest snapshot, at most `max_age` s old or received after the call, and its age in s of the clock.

        Raises `DeadlineError` when there is none in time.
        """
        self._alive()
        called = time.monotonic()

        def usable(snapshot: Snapshot) -> bool:
            return snapshot.stamp >= called or self.age(snapshot) <= max_age

        # Only simulated arms are driven faster than the wall, and they share a busy machine with everything else.
        floor = _FLOOR_S if self._clock.rate <= 1.0 else _FLOOR_FAST_S
        if not self.wait_for(usable, max(floor, self._clock.wall(max_age))):
            self._statistics.count("state too old")
            raise DeadlineError(self._name, f"no state of the arm that is at most {shown(max_age, 's')} old")
        snapshot = self._snapshot
        assert snapshot is not None
        return snapshot, self.age(snapshot)

    def wait_for(self, holds: Callable[[Snapshot], bool], wall_seconds: float) -> bool:
        """Wait until the newest snapshot satisfies `holds`; raises the fault when the link is lost meanwhile."""
        with self._news:
            met = self._news.wait_for(
                lambda: self._lost() or (self._snapshot is not None and holds(self._snapshot)), wall_seconds
            )
        self._alive()
        return met

    def age(self, snapshot: Snapshot) -> float:
        """How old a snapshot is, in s of the clock."""
        return (time.monotonic() - snapshot.stamp) * self._clock.rate

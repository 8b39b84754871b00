"""The gate through which all motion, the laser and the claw are begun: shut for work that is to end.

A stop ends what moves, but a step that plans or settles at that moment would begin its next motion after it. Work
therefore enters the gate with its cancel token: once that is cancelled, or the cell was stopped, it begins nothing
any more, in whatever thread it still goes on. The devices behind the gate are in `cell.devices.gated`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from drivers.errors import Aborted
from statemachine.cancel import CancelToken

Made = TypeVar("Made")


class Gate:
    """Counts the stops; each thread that works remembers the count at which it entered, and its token."""

    def __init__(self) -> None:
        self._stops = 0
        self._entered = threading.local()

    def enter(self, token: CancelToken) -> None:
        """Begin new work in this thread, which `token` ends."""
        self._entered.stops = self._stops
        self._entered.token = token

    def shut(self) -> None:
        """Bar all work that has entered so far. Comes before the devices are stopped."""
        self._stops += 1

    def require(self) -> None:
        """Raise `Aborted` when this thread's work is to end or the cell was stopped since it entered.

        A thread that never entered is not barred.
        """
        token: CancelToken | None = getattr(self._entered, "token", None)
        if token is not None and token.reason is not None:
            raise Aborted(f"{token.reason}; nothing new is begun")
        if getattr(self._entered, "stops", self._stops) != self._stops:
            raise Aborted("the cell was stopped; nothing new is begun")

    def begin(self, start: Callable[[], Made], undo: Callable[[], None]) -> Made:
        """`start()`, unless the cell was stopped; undone at once when it is stopped meanwhile."""
        self.require()
        made = start()
        try:
            self.require()
        except Aborted:
            undo()
            raise
        return made

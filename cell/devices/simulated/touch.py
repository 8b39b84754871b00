"""What a real arm feels of a simulated station: the force of the simulated part on the simulated surface.

The arm's own force counts as ever: whatever really is in the way ends a guarded motion as well.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cell.devices.simulated.following import DeviceFollowing
from drivers.errors import Aborted, CellError
from drivers.interfaces import ArmMotion, ArmState, Vector

log = logging.getLogger(__name__)


class SimulatedTouch:
    """Adds the simulated wrench to a real arm's, and ends its guarded motions at it."""

    def __init__(self, following: DeviceFollowing) -> None:
        self._following = following
        self._zero: Vector = np.zeros(6)

    def zero(self) -> None:
        """Take the present simulated wrench as zero, too."""
        self._zero = self._following.wrench()

    def felt(self, state: ArmState) -> ArmState:
        """The state with the newest simulated wrench in it."""
        return replace(state, wrench=state.wrench + self._following.wrench() - self._zero)

    def recorded(self, states: list[ArmState]) -> None:
        """Put into each of these states the simulated wrench that held at its time."""
        found = self._following.wrenches_at(states)
        states[:] = [
            replace(state, wrench=state.wrench + wrench - self._zero)
            for state, wrench in zip(states, found, strict=True)
        ]

    def guard(self, motion: ArmMotion, limit: float, stop: Callable[[], None]) -> ArmMotion:
        """The same motion, ended by `stop` as soon as the simulated force has changed by `limit` N."""
        return _Guarded(motion, limit, stop, self._following)


class _Guarded:
    """A motion that ends at its own contact or at a simulated one; see `drivers.interfaces.ArmMotion`."""

    def __init__(self, motion: ArmMotion, limit: float, stop: Callable[[], None], following: DeviceFollowing) -> None:
        self._motion, self._limit, self._stop, self._following = motion, limit, stop, following
        self._touched = False
        self._start = following.wrench()[:3]
        self._watch = threading.Thread(target=self._look, name="simulated touch", daemon=True)
        self._watch.start()

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        return self._motion.done

    @property
    def contact(self) -> bool:
        """Whether it ended at its force limit, real or simulated."""
        return self._touched or self._motion.contact

    def wait(self, timeout: float) -> None:
        """See `drivers.interfaces.Motion`."""
        try:
            self._motion.wait(timeout)
        except Aborted:
            if not self._touched:
                raise
        self._watch.join(timeout)

    def _look(self) -> None:
        while not self._motion.done:
            if np.linalg.norm(self._following.next_wrench()[:3] - self._start) >= self._limit:
                self._touched = True
                try:
                    self._stop()
                except CellError as error:
                    log.error("the arm was to stop at a simulated contact: %s", error)
                return

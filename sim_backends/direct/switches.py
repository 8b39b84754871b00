"""Laser and claw in this process that no output of the arm switches: behind their interfaces, straight on the world."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.clock import Clock
from drivers.errors import InterlockError
from drivers.interfaces import Identity, LinkStatistics
from drivers.switches import ConfirmedClaw
from sim_backends.world.world import World

TAKES_S = 0.01
"""From a command until the switch has switched, s."""


class DirectDevice:
    """What all devices in this process share: a name, and no wire."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.statistics = LinkStatistics()

    def ping(self) -> float:
        """No wire: 0 s."""
        return 0.0


class _DirectSwitch(DirectDevice):
    """A switch of the world, "laser" or "claw"."""

    def __init__(self, name: str, world: World, clock: Clock) -> None:
        super().__init__(name)
        self._world = world
        self._clock = clock

    def identity(self) -> Identity:
        """A switch has no plate."""
        return Identity("simulated switch", "virtual", "virtual", "in this process")

    def _set(self, on: bool) -> None:
        self._world.switches[self.name] = on
        self._clock.sleep(TAKES_S)


class DirectLaser(_DirectSwitch):
    """The line laser; see `drivers.interfaces.Laser`."""

    def __init__(self, name: str, world: World, clock: Clock) -> None:
        super().__init__(name, world, clock)
        self._owner = threading.Lock()

    @contextmanager
    def lit(self) -> Iterator[None]:
        """On inside the context, off after it."""
        if not self._owner.acquire(blocking=False):
            raise InterlockError(self.name, "is already lit by another owner. Wait until that one has finished")
        try:
            self._set(True)
            yield
        finally:
            # The world's switch first: waiting may be what ends.
            self._world.switches[self.name] = False
            self._owner.release()

    @property
    def is_on(self) -> bool:
        """What the world's switch shows."""
        return self._world.switches[self.name]

    def stop(self) -> None:
        """Laser off now, whoever has it."""
        self._world.switches[self.name] = False

    def close(self) -> None:
        """Laser off."""
        self.stop()


class DirectClaw(_DirectSwitch, ConfirmedClaw):
    """The claw; see `drivers.interfaces.Claw`."""

    _shown_by = "its feedback"

    @property
    def holding(self) -> bool:
        """Whether the world's claw holds the part."""
        return self._world.part.held

    def stop(self) -> None:
        """The claw stays as it is, because opening would drop the part."""

    def close(self) -> None:
        """The claw stays as it is."""

    def _close(self, closed: bool) -> None:
        self._set(closed)

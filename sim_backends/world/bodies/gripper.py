"""The fingers of an electric gripper that holds, or might hold, the part: where they are at any world time.

Counts go from 0 (open) to 255 (closed). The part is taken when the fingers are told to close within reach of it, and
let go when they are told to open; they stop at its width.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from sim_backends.clock import WorldClock
from sim_backends.world.world import World

PART_AT = 148
"""Where the fingers stand when they hold the part."""
SLOWEST, FASTEST = 60.0, 450.0
"""Counts per second at speed 0 and at 255."""
_REACTION_S = 0.03
"""Until the fingers begin to move, and what the gripper finds becomes that of the new motion."""


@dataclass(frozen=True)
class _Way:
    begun: float
    start: float
    goal: int
    speed: float

    def at(self, t: float) -> float:
        way = max(0.0, t - self.begun) * self.speed
        return min(self.start + way, self.goal) if self.goal > self.start else max(self.start - way, self.goal)


class Gripper:
    """One gripper on the world's claw; safe between threads."""

    def __init__(self, world: World, clock: WorldClock) -> None:
        """It holds the part, or stands closed where a claw without a part does."""
        self._world = world
        self._clock = clock
        self._lock = threading.Lock()
        self.requested = 255
        self._way = _Way(0.0, PART_AT, PART_AT, 0.0)

    def go(self, position: int, speed: int) -> None:
        """Send the fingers to `position` (0 to 255) at `speed` (0 to 255)."""
        with self._lock:
            t = self._clock.now()
            here = self._at(t)
            self.requested = position
            self._world.switches["claw"] = position >= PART_AT
            rate = SLOWEST + (FASTEST - SLOWEST) * speed / 255.0
            self._way = _Way(t + _REACTION_S, here, position, rate)

    def position(self) -> int:
        """Where the fingers are now."""
        with self._lock:
            return round(self._at(self._clock.now()))

    def finding(self) -> int:
        """0 moving, 1 stopped by something while opening, 2 while closing, 3 at the requested position."""
        with self._lock:
            t = self._clock.now()
            here = self._at(t)
            if self._world.part.held and here == PART_AT and self.requested > PART_AT:
                return 2
            if t < self._way.begun or here != self.requested:
                return 0
            return 3

    def _at(self, t: float) -> float:
        if self._world.switches["claw"] and self.requested < PART_AT:
            # A person has filled the claw and closed it.
            self.requested, self._way = 255, _Way(t, PART_AT, PART_AT, 0.0)
        here = self._way.at(t)
        if self._world.part.held and self.requested >= PART_AT:
            # With a part between them they come as far as its width.
            return float(PART_AT) if self._way.start >= PART_AT else min(here, PART_AT)
        return here

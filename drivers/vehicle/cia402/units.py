"""Whether a wheel's speed and its counts tell of the same way: a unit may be wrong, in cell.toml or in the drive."""

from __future__ import annotations

import math

from drivers.clock import Clock
from drivers.vehicle.cia402.geometry import WheelDrives

WAY_M, WALL_S = 0.05, 0.3
"""Over which both are compared, at least: m, and seconds on the wall."""
GAP_WALL_S = 0.1
"""A reading that comes later than this after the last, on the wall, does not say how it went between."""
RATIO = 1.6
"""By which both may differ. Readings that bunch up make a third."""
IN_A_ROW = 2
CREEPS = 0.02
"""Below this, m/s, nothing is compared: an offset of a drive's speed must not add up."""


class UnitCheck:
    """One wheel."""

    def __init__(self, clock: Clock, wheels: WheelDrives) -> None:
        self._clock = clock
        self._count, self._step = wheels.count_length, wheels.velocity_step
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._last: tuple[float, int, int] | None = None
        self._wrong = 0
        self._begin()

    def _begin(self) -> None:
        self._counted = self._told = self._took = 0.0

    def contradiction(self, now: float, position: int, velocity: int) -> float:
        """Take a reading; the ratio of both ways, speed's to counts', where it is wrong in every comparison, else 0."""
        last, self._last = self._last, (now, position, velocity)
        if last is None:
            return 0.0
        took = now - last[0]
        turned = ((position - last[1] + 2**31) % 2**32 - 2**31) * self._count
        stands = abs(velocity) * self._step < CREEPS and abs(turned) < CREEPS * took
        if stands or self._clock.wall(took) > GAP_WALL_S:
            self._begin()
            return 0.0
        self._counted += turned
        self._told += 0.5 * (velocity + last[2]) * self._step * took
        self._took += took
        if self._clock.wall(self._took) < WALL_S or max(abs(self._counted), abs(self._told)) < WAY_M:
            return 0.0
        ratio = self._told / self._counted if self._counted else math.inf
        self._begin()
        self._wrong = 0 if 1.0 / RATIO < ratio < RATIO else self._wrong + 1
        return ratio if self._wrong >= IN_A_ROW else 0.0

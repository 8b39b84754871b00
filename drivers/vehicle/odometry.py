"""Planar odometry of a skid-steered vehicle from the distances of its two sides."""

from __future__ import annotations

import math

_SPAN = 1 << 32
_HALF = 1 << 31


class PlanarOdometry:
    """Integrates the left and right odometers, signed 32-bit counters of `unit` m, for wheels `track` m apart.

    `x`, `y` in m and `yaw` in rad in the frame where the vehicle stood at the first reading.
    """

    def __init__(self, track: float, unit: float = 1e-3) -> None:
        self._track = track
        self._unit = unit
        self._last: tuple[int, int] | None = None
        self.x = 0.0
        self.y = 0.0
        self.yaw = 0.0

    def update(self, left: int, right: int, farthest: float) -> bool:
        """Take a reading; the counters may wrap.

        False when a side has jumped by more than `farthest` m: the vehicle was restarted, and counting goes on from
        this reading without the jump.
        """
        last, self._last = self._last, (left, right)
        if last is None:
            return True
        way_left, way_right = (self._unit * difference(new, old) for new, old in zip((left, right), last, strict=True))
        if max(abs(way_left), abs(way_right)) > farthest:
            return False
        way = 0.5 * (way_left + way_right)
        turn = (way_right - way_left) / self._track
        # Along an arc the chord points half the turn further than the heading before it.
        self.x += way * math.cos(self.yaw + 0.5 * turn)
        self.y += way * math.sin(self.yaw + 0.5 * turn)
        self.yaw += turn
        return True


def difference(new: int, old: int) -> int:
    """Counts from `old` to `new`, the shorter way round of a counter of 32 bits."""
    return (new - old + _HALF) % _SPAN - _HALF

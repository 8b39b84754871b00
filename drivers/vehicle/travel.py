"""How far the wheels have turned: odometry, when it no longer tells where the vehicle is, and who else moved it."""

from __future__ import annotations

import math
from collections import deque

from drivers.clock import Clock
from drivers.interfaces import LinkStatistics
from drivers.vehicle.odometry import PlanarOdometry, difference

REST_AFTER_S = 4.0
"""After its last command to move the vehicle stands within this."""
STANDS_M = 0.005
"""A side that counts more than this without a command has been moved by somebody else."""
_JUMP_M = 0.05
"""What a side may count from one reading to the next besides what it can have driven: readings come in bursts."""
_SWING_M = 0.003
"""A side that counts more than this ahead and as much back from one reading to the next makes a swing."""
SWINGS = 3
"""So many swings within `_SWINGS_S` are two vehicles: no wheel turns back and forth at 20 ms."""
_SWINGS_S = 0.5


class Travel:
    """Odometry of two sides whose counters are signed 32-bit numbers of `unit` m, and what interrupted it.

    `disturbance` says how somebody else moved or commanded the vehicle, until `acknowledge`; `alarms` counts how often
    that happened. Not safe between threads: whoever holds it locks.
    """

    def __init__(
        self,
        clock: Clock,
        statistics: LinkStatistics,
        *,
        track: float,
        max_speed: float,
        max_yaw_rate: float,
        unit: float = 1e-3,
    ) -> None:
        self._clock = clock
        self._statistics = statistics
        self._unit = unit
        self._side_speed = max_speed + 0.5 * track * max_yaw_rate
        self._commanded = -math.inf
        self._rest: tuple[int, int] | None = None
        self._counted = math.nan
        self.odometry = PlanarOdometry(track, unit)
        self.interruptions = 0
        """How often odometry lost its connection to where the vehicle was before."""
        self.interruption = ""
        """Why it did last."""
        self.disturbance = ""
        self.two_vehicles = ""
        """How the counts show two vehicles under the same identifiers; kept until it has passed and is acknowledged."""
        self.alarms = 0
        self._counts: tuple[int, int] | None = None
        self._ways = (0, 0)
        self._swings: deque[float] = deque(maxlen=SWINGS)

    @property
    def driven(self) -> bool:
        """Whether the vehicle may still move by a command of this program."""
        return self._clock.now() - self._commanded < REST_AFTER_S

    def commanded_to_move(self) -> None:
        """A velocity was just sent: what moves for the next `REST_AFTER_S` moves by that."""
        self._commanded = self._clock.now()

    def acknowledge(self) -> None:
        """Whoever takes command now has heard of what others did before."""
        self.disturbance, self._rest = "", None
        if not self.swings():
            self.two_vehicles = ""

    def interrupt(self, why: str) -> None:
        """From now on odometry does not tell where the vehicle is relative to where it was before."""
        self.interruptions += 1
        self.interruption = why

    def disturb(self, what: str) -> None:
        """Somebody else commands or moves the vehicle."""
        self.disturbance = what
        self.alarms += 1
        self.interrupt(what)

    def _look_for_swings(self, now: float, left: int, right: int) -> None:
        last, self._counts = self._counts or (left, right), (left, right)
        ways = (difference(left, last[0]), difference(right, last[1]))
        swings = (
            b * a < 0 and min(abs(b), abs(a)) * self._unit > _SWING_M for a, b in zip(ways, self._ways, strict=True)
        )
        if any(swings):
            self._swings.append(now)
            if self.swings() and not self.two_vehicles:
                first, second = (
                    [f"{1e3 * self._unit * count:.0f}" for count in counts] for counts in (last, self._counts)
                )
                self.two_vehicles = (
                    f"the odometers jump between two series of counts, left and right {' and '.join(first)} mm, then "
                    f"{' and '.join(second)} mm: two vehicles report under the same identifiers"
                )
                self.alarms += 1
                self.interrupt(self.two_vehicles)
        if any(ways):
            self._ways = ways

    def swings(self) -> bool:
        """Whether the counts of two vehicles come at present."""
        recent = self._clock.now() - _SWINGS_S * max(1.0, self._clock.rate)
        return len(self._swings) == SWINGS and self._swings[0] > recent

    def count(self, now: float, left: int, right: int) -> None:
        """Take a reading of both counters at host time `now`."""
        self._look_for_swings(now, left, right)
        before = now if math.isnan(self._counted) else self._counted
        self._counted = now
        # It has driven no longer than since its last reading, and only until it came to rest after its last command.
        driven = max(0.0, min(now, self._commanded + REST_AFTER_S) - before)
        if not self.odometry.update(left, right, _JUMP_M + self._side_speed * driven):
            self._statistics.count("odometry_restarted")
            self.interrupt("its odometers jumped, so it was restarted")
        if now - self._commanded < REST_AFTER_S:
            self._rest = None
        elif self._rest is None:
            self._rest = (left, right)
        elif (moved := self._unit * max(abs(left - self._rest[0]), abs(right - self._rest[1]))) > STANDS_M:
            self.disturb(f"it moved by {1e3 * moved:.0f} mm without a command")
            self._rest = (left, right)

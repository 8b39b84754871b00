"""A constant-velocity sweep and its position at any host time.

The module's counter runs uniformly between the ramps, so a straight line through the samples of that stretch gives
the position between them. A sample's time is only known within its round trip: see `drivers.rail.timing`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drivers.clock import Clock
from drivers.errors import DeviceFault, InterlockError
from drivers.interfaces import Vector
from drivers.rail.motion import RailMotion
from drivers.rail.timing import EvenMotion

_MIN_SAMPLES = 5
_SPEED_TOLERANCE = 0.05
LATCH_S = 0.001
"""A module may answer with a count that it read up to this long before: one turn of its program."""
_LEAST_ROUNDING = 2.0
"""Counts by which a reading may be off besides: its own rounding, and the ramp's."""


class RailSweep(RailMotion):
    """A running sweep, constant between `start` and `stop` (m) at `speed` (m/s); `resolution` is a count in m."""

    def __init__(
        self,
        name: str,
        clock: Clock,
        *,
        start: float,
        stop: float,
        speed: float,
        resolution: float,
        record: list[tuple[float, float, float]],
        arrived: Callable[[], bool],
        halt: Callable[[], None],
        duration: float,
    ) -> None:
        self._start = start
        self._stop = stop
        self._speed = speed
        self._resolution = resolution
        self._record = record
        self._motion: EvenMotion | None = None
        super().__init__(name, clock, arrived=arrived, halt=halt, duration=duration, readings=record)

    @property
    def samples(self) -> Vector:
        """Recorded (n, 2) array of host time in s and position in m, so far."""
        return np.array([row[:2] for row in list(self._record)], dtype=np.float64).reshape(-1, 2)

    @property
    def window(self) -> tuple[float, float]:
        """Host times in s at which the rail was at `start` and at `stop`.

        Raises `InterlockError` while the sweep runs, its own error if it failed, and `DeviceFault`: rail.velocity when
        the samples are too few or show another velocity than the commanded one, rail.uneven when no even motion
        explains all of them.
        """
        motion = self._even()
        return motion.time_at(self._start), motion.time_at(self._stop)

    def position_at(self, host_time: float) -> float:
        """Position in m at a host time inside `window`; `ValueError` outside."""
        begin, end = self.window
        if not begin <= host_time <= end:
            raise ValueError(
                f"{self._name}: {host_time:.4f} s is outside the sweep's constant-velocity window, "
                f"{begin:.4f} to {end:.4f} s"
            )
        return self._even().position_at(host_time)

    @property
    def time_bound(self) -> float:
        """Largest error in s of the times behind `position_at`; see `drivers.interfaces.Sweep`. Raises as `window`."""
        return self._even().time_bound

    @property
    def unevenness(self) -> float:
        """Median distance in m of the readings from an even motion; see `drivers.interfaces.Sweep`."""
        return self._even().unevenness

    def _even(self) -> EvenMotion:
        if not self.done:
            raise InterlockError(
                self._name, "the sweep still runs; its window is known once it has ended. wait() first"
            )
        if self.error is not None:
            raise self.error
        if self._motion is None:
            self._motion = self._fit()
        return self._motion

    def _fit(self) -> EvenMotion:
        rows = np.array(self._record, dtype=np.float64).reshape(-1, 3)
        low, high = sorted((self._start, self._stop))
        inside = rows[(rows[:, 1] >= low) & (rows[:, 1] <= high)]
        if len(inside) < _MIN_SAMPLES:
            raise self._fault(
                f"only {len(inside)} positions were read between start and stop, at least {_MIN_SAMPLES} are needed"
            )
        motion = EvenMotion.of(inside[:, 0], inside[:, 1], inside[:, 2])
        expected = np.copysign(self._speed, self._stop - self._start)
        if not abs(motion.velocity - expected) <= _SPEED_TOLERANCE * self._speed:
            raise self._fault(
                f"the rail ran at {motion.velocity * 1e3:.3f} mm/s instead of {expected * 1e3:.3f} mm/s "
                f"(allowed ±{_SPEED_TOLERANCE:.0%})"
            )
        allowed = _LEAST_ROUNDING * self._resolution + LATCH_S * self._speed
        if motion.residual > allowed:
            raise DeviceFault(
                self._name,
                "rail.uneven",
                f"the readings of the sweep lie up to {motion.residual * 1e3:.3f} mm off every even motion, more than "
                f"their round trips explain (allowed {allowed * 1e3:.3f} mm: {_LEAST_ROUNDING:.0f} counts, and "
                f"{LATCH_S * 1e3:.0f} ms at {self._speed * 1e3:.3g} mm/s)",
                recoverable=True,
                hint="Look whether the carriage jams, whether another program set the module's ramp (axis parameters "
                "5 and 15 to 20) or stops the motor, then sweep again.",
            )
        return motion

    def _fault(self, message: str) -> DeviceFault:
        return DeviceFault(
            self._name,
            "rail.velocity",
            message,
            recoverable=True,
            hint="Sweep more slowly or farther; check lead, microsteps and that nothing else drives the rail.",
        )

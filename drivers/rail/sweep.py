"""A constant-velocity sweep and its position at any host time.

The module's counter runs uniformly between the ramps, so a straight line through the samples of that stretch gives
the position between them. A sample's time is only known within its round trip.

The counter held at some instant between request and reply, wherever in between. Readings of one even motion bound each
other: a reading before and one after a place confine the time at which it was passed, so the shortest round trips tell
the time and slow ones do no harm. What all replies are late by stays unknown, and is stated."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from drivers.clock import Clock
from drivers.errors import DeviceFault, InterlockError
from drivers.interfaces import Vector
from drivers.rail.motion import RailMotion

_PLACES = (0.1, 0.3, 0.5, 0.7, 0.9)
_MOST = 400
"""So many of the shortest round trips are looked at; pairs are formed of them."""
_SLOWEST, _FASTEST, _STEPS = 0.5, 1.5, 80
"""Where the speed is looked for, as a share of that of the fitted line, and in how many thirds."""


def passing_times(place: float, positions: Vector, before: Vector, after: Vector) -> tuple[float, float]:
    """Earliest and latest time in s at which an even motion may have passed `place` (m).

    It was at `positions` (n,), m, between the host times `before` and `after` (n,), s; some of them lie on either side
    of `place`. The time at `place` is the one between those of a reading on each side, in the ratio of the distances.
    """
    here = np.flatnonzero(positions <= place)
    there = np.flatnonzero(positions > place)
    gap = positions[there][None, :] - positions[here][:, None]
    share = (place - positions[here])[:, None] / gap
    latest = after[here][:, None] * (1.0 - share) + after[there][None, :] * share
    earliest = before[here][:, None] * (1.0 - share) + before[there][None, :] * share
    return float(earliest.max()), float(latest.min())


def least_residual(positions: Vector, before: Vector, after: Vector, velocity: float) -> float:
    """By how many m the readings differ, at least, from every even motion of about `velocity` (m/s); 0 if one fits.

    Each was at `positions` (n,), m, at some host time between `before` and `after` (n,), s. The best motion leaves the
    worst reading that far off: late replies explain what they can, and nothing else is explained.
    """
    middle = 0.5 * (before + after).mean()
    begin, end = before - middle, after - middle

    def worst(speed: float) -> float:
        reached = np.stack([speed * begin, speed * end])
        return float((positions - reached.max(axis=0)).max() - (positions - reached.min(axis=0)).min()) / 2.0

    low, high = sorted((_SLOWEST * velocity, _FASTEST * velocity))
    for _ in range(_STEPS):
        third = (high - low) / 3.0
        # The worst reading's distance is a convex function of the speed.
        if worst(low + third) < worst(high - third):
            high -= third
        else:
            low += third
    return max(0.0, worst(0.5 * (low + high)))


@dataclass(frozen=True)
class EvenMotion:
    """The line through the readings of an even motion: `origin` is the position in m at time 0 s, `velocity` in m/s.

    `time_bound` in s is the largest error that the line's times may have, as far as round trips confine it: the larger
    distance to the ends of what they leave open, at the worst of several places. `unevenness` in m is the median
    distance of the readings from the line beyond what their round trips explain; a motion in which it is not next to
    nothing was not even, and its bound says nothing. `residual` in m is by how much the worst reading is off the even
    motion that fits best, again beyond what round trips explain: see `least_residual`.
    """

    origin: float
    velocity: float
    time_bound: float
    unevenness: float
    residual: float

    @classmethod
    def of(cls, times: Vector, positions: Vector, round_trips: Vector) -> Self:
        """From (n,) readings: host time of the middle of the round trip in s, position in m, round trip in s. The line
        is that of `fit_line`, moved to where the readings confine it should it lie outside."""
        origin, velocity = fit_line(times, positions, round_trips)
        best = np.argsort(round_trips, kind="stable")[:_MOST]
        before, after = (times + 0.5 * round_trips * sign for sign in (-1.0, 1.0))
        low, high = float(positions[best].min()), float(positions[best].max())
        places = [low + fraction * (high - low) for fraction in _PLACES]
        spans = [passing_times(place, positions[best], before[best], after[best]) for place in places]
        earliest, latest = spans[len(spans) // 2]
        drawn = (places[len(places) // 2] - origin) / velocity
        if earliest <= latest:
            origin -= velocity * (min(max(drawn, earliest), latest) - drawn)
        passed = [(place - origin) / velocity for place in places]
        bound = max(max(abs(span[1] - t), abs(t - span[0])) for t, span in zip(passed, spans, strict=True))
        beyond = np.abs(positions - origin - velocity * times) - 0.5 * round_trips * abs(velocity)
        residual = least_residual(positions, times - 0.5 * round_trips, times + 0.5 * round_trips, velocity)
        return cls(origin, velocity, bound, float(np.median(np.maximum(beyond, 0.0))), residual)

    def position_at(self, time: float) -> float:
        """Position in m at a host time in s."""
        return self.origin + self.velocity * time

    def time_at(self, position: float) -> float:
        """Host time in s at which it was at `position` m."""
        return (position - self.origin) / self.velocity


def fit_line(times: Vector, positions: Vector, round_trips: Vector) -> tuple[float, float]:
    """Least-squares line through (n,) samples: position in m at time 0 s and velocity in m/s.

    The counter held at some instant within the round trip, taken as uniformly distributed, so a sample's weight is
    1 / round trip²: late samples hardly count, even where nearly all of them are. Round trips are floored at half of
    their 5th percentile, because a very short one does not make the counter's last digit any finer.
    """
    weights = 1.0 / np.square(np.maximum(round_trips, 0.5 * np.quantile(round_trips, 0.05) + 1e-9))
    total = weights.sum()
    centre = (weights * times).sum() / total
    mean = (weights * positions).sum() / total
    along = times - centre
    velocity = float((weights * along * (positions - mean)).sum() / (weights * along * along).sum())
    return float(mean - velocity * centre), velocity


_MIN_SAMPLES = 5
_SPEED_TOLERANCE = 0.05
LATCH_S = 0.001
"""A module may answer with a count that it read up to this long before: one turn of its program."""
_LEAST_ROUNDING = 2.0
"""Counts by which a reading may be off besides: its own rounding, and the ramp's."""


class EvenSweep(ABC):
    """Where the rail was in its sweep, by the even motion that explains its readings."""

    _name: str
    _start: float
    _stop: float

    @abstractmethod
    def _even(self) -> EvenMotion:
        """That motion; raises why there is none (yet)."""

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


class RailSweep(EvenSweep, RailMotion):
    """A running sweep, constant between `start` and `stop` (m) at `speed` (m/s); `resolution` is a count in m."""

    def __init__(
        self, name: str, clock: Clock, *, start: float, stop: float, speed: float, resolution: float,
        record: list[tuple[float, float, float]], arrived: Callable[[], bool], halt: Callable[[], None],
        duration: float,
    ) -> None:  # fmt: skip
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
            self._name, "rail.velocity", message, recoverable=True,
            hint="Sweep more slowly or farther; check lead, microsteps and that nothing else drives the rail.",
        )  # fmt: skip

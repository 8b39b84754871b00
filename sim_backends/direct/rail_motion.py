"""Motions of the rail in this process: how they arrive, or why they never will, and what a sweep has read."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, InterlockError
from drivers.interfaces import Vector
from sim_backends.direct.product import CarriageCheck, SweepLine

if TYPE_CHECKING:
    from sim_backends.direct.rail import DirectRail

POLL_S = 0.010
STANDSTILL_S = 0.5
"""A motor that has not moved for this long before its target has stalled."""


class RailMove:
    """A motion of the rail to `target` in counts, or to its home switch (None), with an eye of `watch` on it.

    `asked` is what tells that a motion in several legs has ended."""

    def __init__(
        self,
        rail: DirectRail,
        target: int | None,
        watch: CarriageCheck | None = None,
        asked: Callable[[], bool] | None = None,
    ) -> None:
        self._rail = rail
        self._asked = asked
        self._watch = watch
        self._target = target
        self._issued = rail.stops
        self._begun = self._moved = rail.clock.now()
        self._last: int | None = None
        self._ended = False
        self._error: CellError | None = None

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        if not self._ended:
            self._judge()
        return self._ended

    def arrived(self) -> bool:
        """As `done`; raises why it never will."""
        if self.done and self._error is not None:
            raise self._error
        return self._ended

    def wait(self, timeout: float) -> None:
        """Let time pass until the rail has arrived; see `drivers.interfaces.Motion`."""
        clock = self._rail.clock
        deadline = clock.now() + timeout
        while not self.done:
            if clock.now() > deadline:
                self._rail.stop()
                self._end(
                    DeadlineError(
                        self._rail.name,
                        f"the motion has not ended within {timeout:.3g} s and was stopped. Check that the rail runs "
                        "freely, or allow more time",
                    )
                )
                break
            clock.sleep(POLL_S)
        if self._error is not None:
            raise self._error

    def _end(self, error: CellError | None) -> None:
        self._error, self._ended = error, True

    def _judge(self) -> None:
        """End the motion if the rail has arrived, or never will."""
        rail, model, now = self._rail, self._rail.model, self._rail.clock.now()
        if rail.lost_zero:
            self._end(rail.reset_fault("in its motion"))
        elif rail.stops != self._issued:
            self._end(Aborted(f"{rail.name}: stopped at {1e3 * rail.counted(now):.3f} mm before its target"))
        elif (fault := self._seen(now)) is not None:
            rail.stop()
            self._end(fault)
        elif self._asked is not None:
            try:
                if self._asked():
                    self._end(None)
            except CellError as error:
                rail.stop()
                self._end(error)
        elif self._target is None:
            if not model.searching(now) and model.velocity(now) == 0:
                rail.found_zero()
                self._end(None)
        elif model.reached(now):
            self._end(None)
        elif (position := model.position(now)) != self._last:
            self._last, self._moved = position, now
        elif now - self._moved > STANDSTILL_S and model.velocity(now) == 0:
            self._end(self._failure(now))

    def _seen(self, now: float) -> DeviceFault | None:
        rail, model = self._rail, self._rail.model
        if self._watch is None:
            return None
        try:
            switches = model.left_switch(now), model.right_switch(now)
            self._watch(rail.counted(now), *switches, lambda: model.stalled(now))
        except DeviceFault as fault:
            return fault
        return None

    def _failure(self, now: float) -> DeviceFault:
        rail, model = self._rail, self._rail.model
        rail.forget_zero()
        short = f"stands at {1e3 * rail.counted(now):.3f} mm, short of its target"
        for side, hit in (("left", model.left_switch(now)), ("right", model.right_switch(now))):
            if hit:
                return DeviceFault(
                    rail.name,
                    "rail.limit_switch",
                    f"{short}: the {side} limit switch is hit",
                    recoverable=True,
                    hint="Home the rail again and check the configured travel.",
                )
        return DeviceFault(
            rail.name,
            "rail.stalled",
            f"{short}: the motor does not move" + (" (stall detected)" if model.stalled(now) else ""),
            recoverable=True,
            hint="See whether the carriage is blocked and the motor has current, then home again.",
        )


class DirectSweep(RailMove):
    """A sweep with a reading every 10 ms; between them the line that is fitted to them."""

    def __init__(self, rail: DirectRail, target: int, start: float, stop: float) -> None:
        super().__init__(rail, target)
        self._start, self._stop = start, stop
        self._readings: list[tuple[float, float]] = []
        self._motion: SweepLine | None = None

    @property
    def samples(self) -> Vector:
        """Recorded (n, 2) array of host time in s and position in m, so far."""
        # The model knows its past exactly: what was to be read meanwhile is read now.
        while (due := self._begun + len(self._readings) * POLL_S) + self._rail.round_trip <= self._rail.clock.now():
            self._readings.append(self._rail.read(due))
        return np.array(self._readings, dtype=np.float64).reshape(-1, 2)

    @property
    def window(self) -> tuple[float, float]:
        """Host times between which the velocity is constant; `InterlockError` while the sweep runs."""
        motion = self._even()
        return motion.time_at(self._start), motion.time_at(self._stop)

    def position_at(self, host_time: float) -> float:
        """Position in m at a host time inside `window`; `ValueError` outside."""
        begin, end = self.window
        if not begin <= host_time <= end:
            raise ValueError(f"{host_time:.4f} s is outside the sweep's window, {begin:.4f} to {end:.4f} s")
        return self._even().position_at(host_time)

    @property
    def time_bound(self) -> float:
        """Largest error in s of the times behind `position_at`; see `drivers.interfaces.Sweep`."""
        return self._even().time_bound

    @property
    def unevenness(self) -> float:
        """Median distance in m of the readings from an even motion; see `drivers.interfaces.Sweep`."""
        return self._even().unevenness

    def _even(self) -> SweepLine:
        if not self.done:
            raise InterlockError(self._rail.name, "the sweep still runs. wait() first")
        if self._error is not None:
            raise self._error
        if self._motion is None:
            readings = self.samples
            low, high = sorted((self._start, self._stop))
            inside = readings[(readings[:, 1] >= low) & (readings[:, 1] <= high)]
            trips = np.full(len(inside), self._rail.round_trip)
            self._motion = self._rail.setup.even(inside[:, 0], inside[:, 1], trips)
        return self._motion

"""The simulated rail in lock step: positions are read as a driver on a wire reads them, somewhere in a round trip."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from cell.devices.built_in import TmclRailConfig
from drivers.clock import Clock
from drivers.errors import DeadlineError, InterlockError
from drivers.interfaces import Identity, LinkStatistics, RailState, Vector
from drivers.quantities import check_range
from drivers.rail.motion import POLL_S, SWEEP_MARGIN_M, run_up_distance
from drivers.rail.timing import EvenMotion
from sim_backends.models.rail import RailModel

ROUND_TRIP_S = 0.0005
"""Between a request and its reply; the module answers somewhere in between."""
_AT_START_M = 20e-6
_HOME_SWITCH_MODE = 5


class LockstepRail:
    """The rail `model` as a controller in microsteps shows it; see `drivers.interfaces.Rail` for the promises."""

    def __init__(
        self, name: str, model: RailModel, clock: Clock, config: TmclRailConfig, wire: np.random.Generator
    ) -> None:
        """`wire` draws when within a round trip the module answers."""
        self.name = name
        self.statistics = LinkStatistics()
        self.travel = config.travel
        self.model = model
        self._clock = clock
        self._config = config
        self._wire = wire
        self._counts = config.steps_per_turn * config.microsteps / config.lead
        self._homed = False
        self.late = 0.0
        """By how many seconds each reply comes later than the module answers."""
        self.model.configure(
            clock.now(),
            dataclasses.replace(
                model.settings,
                microsteps=config.microsteps.bit_length() - 1,
                max_acceleration=self._pulses(config.acceleration),
                search_mode=_HOME_SWITCH_MODE,
                search_speed=self._pulses(0.5 * config.max_speed),
                switch_speed=self._pulses(0.1 * config.max_speed),
            ),
        )

    def identity(self) -> Identity:
        """The model's own plate."""
        return Identity("TMCM-1260", str(self.model.params.serial), "lock step", "in this process")

    def ping(self) -> float:
        """No wire: 0 s."""
        return 0.0

    @property
    def round_trip(self) -> float:
        """Seconds from a request to its reply."""
        return ROUND_TRIP_S + self.late

    def counted(self, t: float) -> float:
        """Position in m as the step counter has it at world time `t`."""
        return self.model.position(t) / self._counts

    def read(self, t: float) -> tuple[float, float]:
        """Host time in s and position in m of a reading that is asked for at `t`."""
        answered = t + float(self._wire.uniform(0.0, ROUND_TRIP_S))
        return t + 0.5 * self.round_trip, self.counted(answered)

    def state(self) -> RailState:
        """Read position, velocity and switches now."""
        now = self._clock.now()
        stamp, position = self.read(now)
        velocity = self.model.velocity(now) / self._counts
        return RailState(
            stamp=stamp,
            position=position,
            velocity=velocity,
            homed=self._homed,
            homed_here=self._homed,
            moving=velocity != 0.0 or self.model.searching(now),
            left_switch=self.model.left_switch(now),
            right_switch=self.model.right_switch(now),
        )

    def home(self) -> RailMove:
        """Search the home switch; position 0 is there afterwards."""
        self.model.search(self._clock.now())
        self._homed = True
        return RailMove(self, self._clock)

    def move_to(self, position: float, speed: float | None = None) -> RailMove:
        """Move to `position` m; refused with `InterlockError` before homing."""
        self._start(check_range(self.name, "position", position, *self.travel, "m"), speed or self._config.max_speed)
        return RailMove(self, self._clock)

    def sweep_start(self, start: float, stop: float, speed: float) -> float:
        """Where the rail has to stand before `sweep`."""
        return self._ends(start, stop, speed)[0]

    def sweep(self, start: float, stop: float, speed: float) -> LockstepSweep:
        """Move so that the velocity is constant from `start` to `stop`; see `drivers.interfaces.Rail`."""
        begin, end = self._ends(start, stop, speed)
        here = self.counted(self._clock.now())
        if abs(here - begin) > _AT_START_M:
            raise InterlockError(
                self.name, f"stands at {1e3 * here:.3f} mm, the sweep starts at {1e3 * begin:.3f} mm. Move there first"
            )
        self._start(end, speed)
        return LockstepSweep(self, self._clock, start, stop)

    def stop(self) -> None:
        """Stop on the ramp."""
        self.model.rotate(self._clock.now(), 0)

    def close(self) -> None:
        """Nothing to let go of."""

    def _ends(self, start: float, stop: float, speed: float) -> tuple[float, float]:
        ramp = math.copysign(run_up_distance(speed, self._config.acceleration) + SWEEP_MARGIN_M, stop - start)
        begin = check_range(self.name, "sweep start less its start-up", start - ramp, *self.travel, "m")
        return begin, check_range(self.name, "sweep stop plus its run-out", stop + ramp, *self.travel, "m")

    def _start(self, position: float, speed: float) -> None:
        if not self._homed:
            raise InterlockError(self.name, "is not homed, so positions mean nothing yet. Call home() first")
        now = self._clock.now()
        self.model.configure(now, dataclasses.replace(self.model.settings, max_velocity=self._pulses(speed)))
        self.model.move_to(now, round(position * self._counts))

    def _pulses(self, value: float) -> int:
        return max(1, round(value * self._counts))


class RailMove:
    """A motion of the rail."""

    def __init__(self, rail: LockstepRail, clock: Clock) -> None:
        self._rail = rail
        self._clock = clock
        self._begun = clock.now()

    @property
    def done(self) -> bool:
        """True once the rail stands at its target."""
        now = self._clock.now()
        return self._rail.model.reached(now) and not self._rail.model.searching(now)

    def wait(self, timeout: float) -> None:
        """Let time pass until the rail has arrived; see `drivers.interfaces.Motion`."""
        deadline = self._clock.now() + timeout
        while not self.done:
            if self._clock.now() > deadline:
                self._rail.stop()
                raise DeadlineError(self._rail.name, f"the motion has not ended within {timeout:g} s")
            self._clock.sleep(POLL_S)


class LockstepSweep(RailMove):
    """A sweep with a reading every 10 ms; between them the driver's straight line."""

    def __init__(self, rail: LockstepRail, clock: Clock, start: float, stop: float) -> None:
        super().__init__(rail, clock)
        self._start, self._stop = start, stop
        self._readings: list[tuple[float, float]] = []
        self._motion: EvenMotion | None = None

    @property
    def samples(self) -> Vector:
        """Recorded (n, 2) array of host time in s and position in m, so far."""
        # The model knows its past exactly: what was to be read meanwhile is read now.
        while (due := self._begun + len(self._readings) * POLL_S) + self._rail.round_trip <= self._clock.now():
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

    def _even(self) -> EvenMotion:
        if not self.done:
            raise InterlockError(self._rail.name, "the sweep still runs. wait() first")
        if self._motion is None:
            readings = self.samples
            low, high = sorted((self._start, self._stop))
            inside = readings[(readings[:, 1] >= low) & (readings[:, 1] <= high)]
            trips = np.full(len(inside), self._rail.round_trip)
            self._motion = EvenMotion.of(inside[:, 0], inside[:, 1], trips)
        return self._motion

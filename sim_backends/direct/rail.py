"""The rail in this process: positions are read as a driver on a wire reads them, somewhere in a round trip."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from drivers.errors import DeviceFault, InterlockError
from drivers.interfaces import LONGEST_NUDGE_M, Identity, LinkStatistics, RailState
from sim_backends.direct.clock import VirtualClock
from sim_backends.direct.product import CarriageCheck, RailSetup, within
from sim_backends.direct.rail_motion import POLL_S, DirectSweep, RailMove
from sim_backends.models.rail import RailModel

ROUND_TRIP_S = 0.0005
"""Between a request and its reply; the module answers somewhere in between."""
SWEEP_MARGIN_M = 0.5e-3
"""Added to a sweep's ramp: takes up backlash and rounding."""
_AT_START_M = 20e-6
_HOME_SWITCH_MODE = 5


class DirectRail:
    """The rail `model` as a controller in microsteps shows it; see `drivers.interfaces.Rail` for the promises."""

    def __init__(
        self, name: str, model: RailModel, clock: VirtualClock, setup: RailSetup, wire: np.random.Generator
    ) -> None:
        """`wire` draws when within a round trip the module answers."""
        self.name = name
        self.statistics = LinkStatistics()
        self.travel = setup.travel
        self.model = model
        self.clock = clock
        self.setup = setup
        self.stops = 0
        """How often it was stopped: a motion that began before the newest stop has ended with it."""
        self.late = 0.0
        """By how many seconds each reply comes later than the module answers."""
        self._wire = wire
        self._counts = setup.steps_per_turn * setup.microsteps / setup.lead
        self._homed = False
        self._lost = False
        self._motion: RailMove | None = None
        self._set_up()

    def identity(self) -> Identity:
        """The model's own plate, or the number by which the cell knows it."""
        serial = self.setup.serial or str(self.model.params.serial)
        return Identity("simulated rail", serial, "virtual", "in this process")

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
        """Read position, velocity and switches now; `DeviceFault` (rail.reset), once, when the zero was lost."""
        if self._lost:
            raise self.reset_fault("since its last motion")
        now = self.clock.now()
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
        self._require_free()
        self._set_up()
        self._homed = self._lost = False
        self.model.search(self.clock.now())
        self._motion = RailMove(self, None, self._watch(self.travel[1] - self.travel[0]))
        return self._motion

    def move_to(self, position: float, speed: float | None = None) -> RailMove:
        """Move to `position` m; refused with `InterlockError` before homing."""
        within(self.name, "position", position, *self.travel, "m")
        speed = self._checked(self.setup.max_speed if speed is None else speed)
        self._motion = RailMove(self, self._start(position, speed))
        return self._motion

    def nudge(self, distance: float, speed: float) -> RailMove:
        """Move by `distance` m, whether homed or not."""
        within(self.name, "distance of a nudge", distance, low=-LONGEST_NUDGE_M, high=LONGEST_NUDGE_M, unit="m")
        self._require_free()
        now = self.clock.now()
        target = self.model.position(now) + round(distance * self._counts)
        self._send(target, self._checked(speed))
        self._motion = RailMove(self, target, self._watch(None))
        return self._motion

    def check_zero(self) -> RailMove:
        """Creep over the home switch and end at 0; see `drivers.interfaces.ChecksZero`."""

        def begin(position: float, speed: float) -> Callable[[], bool]:
            target = round(position * self._counts)
            self._send(target, speed)
            return RailMove(self, target).arrived

        self._require_free()
        self._require_zero()
        model, clock = self.model, self.clock
        check = self.setup.check(
            self.name,
            begin,
            lambda: self.counted(clock.now()),
            lambda: model.home_switch(clock.now()),
            self.forget_zero,
            self.setup.max_speed,
        )
        self._motion = RailMove(self, None, asked=check)
        return self._motion

    def sweep_start(self, start: float, stop: float, speed: float) -> float:
        """Where the rail has to stand before `sweep`."""
        return self._ends(start, stop, speed)[0]

    def sweep(self, start: float, stop: float, speed: float) -> DirectSweep:
        """Move so that the velocity is constant from `start` to `stop`; see `drivers.interfaces.Rail`."""
        begin, end = self._ends(start, stop, speed)
        here = self.counted(self.clock.now())
        if abs(here - begin) > _AT_START_M:
            raise InterlockError(
                self.name,
                f"stands at {1e3 * here:.3f} mm, the sweep starts at {1e3 * begin:.3f} mm. Move to sweep_start() first",
            )
        sweep = DirectSweep(self, self._start(end, speed), start, stop)
        self._motion = sweep
        return sweep

    def stop(self) -> None:
        """Stop on the ramp, and wait for its end: no time passes by itself. What is under way ends with `Aborted`."""
        self.stops += 1
        self.model.rotate(self.clock.now(), 0)
        while self.model.velocity(self.clock.now()) != 0:
            self.clock.sleep(POLL_S)

    def close(self) -> None:
        """Stop."""
        self.stop()

    # --- the zero ---

    def found_zero(self) -> None:
        """The search has come to its end."""
        self._homed = True

    def forget_zero(self) -> None:
        """The count can no longer be trusted."""
        self._homed = False

    @property
    def lost_zero(self) -> bool:
        """Whether the module was reset and nobody was told yet."""
        return self._lost

    def reset_fault(self, when: str) -> DeviceFault:
        """The fault of a module that was reset; told once."""
        self._lost = False
        return DeviceFault(
            self.name,
            "rail.reset",
            f"the module has lost its zero {when}: it was reset or without power",
            recoverable=True,
            hint="Home the rail again; check the module's supply.",
        )

    def reset(self) -> None:
        """What is to happen to the module: it starts anew, and has forgotten its zero and its settings."""
        self._lost, self._homed = self._homed or self.model.searching(self.clock.now()), False
        self.model.reset(self.clock.now())

    # --- inside ---

    def _watch(self, length: float | None) -> CarriageCheck:
        return self.setup.watch(self.name, self.clock, length)

    def _set_up(self) -> None:
        """Tell the module what it forgets when it is reset."""
        setup = self.setup
        self.model.configure(
            self.clock.now(),
            dataclasses.replace(
                self.model.settings,
                microsteps=setup.microsteps.bit_length() - 1,
                reverse_shaft=setup.reversed,
                max_acceleration=self._pulses(setup.acceleration),
                search_mode=_HOME_SWITCH_MODE,
                search_speed=self._pulses(0.5 * setup.max_speed),
                switch_speed=self._pulses(0.1 * setup.max_speed),
            ),
        )

    def _ends(self, start: float, stop: float, speed: float) -> tuple[float, float]:
        speed = self._checked(speed)
        if start == stop:
            raise InterlockError(self.name, f"a sweep from {1e3 * start:.3f} mm to the same place has no direction")
        run_up = speed * speed / (2.0 * self.setup.acceleration)
        ramp = math.copysign(run_up + SWEEP_MARGIN_M, stop - start)
        begin = within(self.name, "sweep start less its start-up", start - ramp, *self.travel, "m")
        return begin, within(self.name, "sweep stop plus its run-out", stop + ramp, *self.travel, "m")

    def _checked(self, speed: float) -> float:
        return within(self.name, "speed", speed, low=1e-9, high=self.setup.max_speed, unit="m/s")

    def _start(self, position: float, speed: float) -> int:
        """Send it there; the target in counts."""
        self._require_free()
        self._require_zero()
        target = round(position * self._counts)
        self._send(target, speed)
        return target

    def _require_zero(self) -> None:
        if self._lost:
            raise self.reset_fault("since its last motion")
        if not self._homed:
            raise InterlockError(self.name, "is not homed, so positions mean nothing yet. Call home() first")

    def _send(self, target: int, speed: float) -> None:
        now = self.clock.now()
        self.model.configure(now, dataclasses.replace(self.model.settings, max_velocity=self._pulses(speed)))
        self.model.move_to(now, target)

    def _require_free(self) -> None:
        if self._motion is not None and not self._motion.done:
            raise InterlockError(self.name, "another motion runs. Wait for it or stop() it first")

    def _pulses(self, value: float) -> int:
        return max(1, round(value * self._counts))

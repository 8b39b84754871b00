"""The rail in this process: positions are read as a driver on a wire reads them, somewhere in a round trip."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.clock import Clock
from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, InterlockError, check_range
from drivers.interfaces import LONGEST_NUDGE_M, Identity, RailState, Vector
from drivers.rail.motion import POLL_S, STANDSTILL_S, SWEEP_MARGIN_M, CarriageWatch, ZeroCheck, run_up_distance
from drivers.rail.sweep import EvenMotion, EvenSweep
from sim_backends.direct.switches import DirectDevice
from sim_backends.models.rail import RailModel


@dataclass(frozen=True)
class RailSetup:
    """How the rail is driven: m, m/s, m/s²; `reversed` turns its motor round. `serial` is the number by which the cell
    knows it; None where it tells its own."""

    lead: float
    steps_per_turn: int
    microsteps: int
    travel: tuple[float, float]
    max_speed: float
    acceleration: float
    reversed: bool
    serial: str | None = None


class RailMove:
    """A motion of the rail to `target` in counts, or to its home switch (None), with an eye of `watch` on it.

    `asked` is what tells that a motion in several legs has ended."""

    def __init__(
        self, rail: "DirectRail", target: int | None, watch: CarriageWatch | None = None,
        asked: Callable[[], bool] | None = None,
    ) -> None:  # fmt: skip
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
                # First: whoever waits while it stops may be ended by that.
                self._end(error)
                rail.stop()
        elif self._target is None:
            if not model.searching(now) and model.velocity(now) == 0:
                rail.homed = True
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
                    rail.name, "rail.limit_switch", f"{short}: the {side} limit switch is hit", recoverable=True,
                    hint="Home the rail again and check the configured travel.",
                )  # fmt: skip
        return DeviceFault(
            rail.name, "rail.stalled",
            f"{short}: the motor does not move" + (" (stall detected)" if model.stalled(now) else ""), recoverable=True,
            hint="See whether the carriage is blocked and the motor has current, then home again.",
        )  # fmt: skip


class DirectSweep(EvenSweep, RailMove):
    """A sweep with a reading every 10 ms; between them the line that is fitted to them."""

    def __init__(self, rail: "DirectRail", target: int, start: float, stop: float) -> None:
        super().__init__(rail, target)
        self._name, self._start, self._stop = rail.name, start, stop
        self._readings: list[tuple[float, float]] = []
        self._motion: EvenMotion | None = None

    @property
    def samples(self) -> Vector:
        """Recorded (n, 2) array of host time in s and position in m, so far."""
        # The model knows its past exactly: what was to be read meanwhile is read now.
        while (due := self._begun + len(self._readings) * POLL_S) + self._rail.round_trip <= self._rail.clock.now():
            self._readings.append(self._rail.read(due))
        return np.array(self._readings, dtype=np.float64).reshape(-1, 2)

    def _even(self) -> EvenMotion:
        if not self.done:
            raise InterlockError(self._rail.name, "the sweep still runs. wait() first")
        if self._error is not None:
            raise self._error
        if self._motion is None:
            readings = self.samples
            low, high = sorted((self._start, self._stop))
            inside = readings[(readings[:, 1] >= low) & (readings[:, 1] <= high)]
            trips = np.full(len(inside), self._rail.round_trip)
            self._motion = EvenMotion.of(inside[:, 0], inside[:, 1], trips)
        return self._motion


ROUND_TRIP_S = 0.0005
"""Between a request and its reply; the module answers somewhere in between."""
_AT_START_M = 20e-6
_HOME_SWITCH_MODE = 5


class DirectRail(DirectDevice):
    """The rail `model` as a controller in microsteps shows it; see `drivers.interfaces.Rail` for the promises."""

    def __init__(self, name: str, model: RailModel, clock: Clock, setup: RailSetup, wire: np.random.Generator) -> None:
        """`wire` draws when within a round trip the module answers."""
        super().__init__(name)
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
        self.homed = False
        self.lost_zero = False
        """Whether the module was reset and nobody was told yet."""
        self._motion: RailMove | None = None
        self._checking: RailMove | None = None
        self._set_up()

    def identity(self) -> Identity:
        """The model's own plate, or the number by which the cell knows it."""
        serial = self.setup.serial or str(self.model.params.serial)
        return Identity("simulated rail", serial, "virtual", "in this process")

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
        if self.lost_zero:
            raise self.reset_fault("since its last motion")
        now = self.clock.now()
        stamp, position = self.read(now)
        velocity = self.model.velocity(now) / self._counts
        return RailState(
            stamp=stamp, position=position, velocity=velocity, homed=self.homed, homed_here=self.homed,
            moving=velocity != 0.0 or self.model.searching(now), left_switch=self.model.left_switch(now),
            right_switch=self.model.right_switch(now),
        )  # fmt: skip

    def home(self) -> RailMove:
        """Search the home switch; position 0 is there afterwards."""
        self._require_free()
        self._set_up()
        self.homed = self.lost_zero = False
        self.model.search(self.clock.now())
        self._motion = RailMove(self, None, self._watch(self.travel[1] - self.travel[0]))
        return self._motion

    def move_to(self, position: float, speed: float | None = None) -> RailMove:
        """Move to `position` m; refused with `InterlockError` before homing."""
        check_range(self.name, "position", position, *self.travel, "m")
        speed = self._checked(self.setup.max_speed if speed is None else speed)
        self._motion = RailMove(self, self._start(position, speed))
        return self._motion

    def nudge(self, distance: float, speed: float) -> RailMove:
        """Move by `distance` m, whether homed or not."""
        check_range(self.name, "distance of a nudge", distance, low=-LONGEST_NUDGE_M, high=LONGEST_NUDGE_M, unit="m")
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
        check = ZeroCheck(
            self.name, begin, lambda: self.counted(clock.now()), lambda: model.home_switch(clock.now()),
            forget=self.forget_zero, speed=self.setup.max_speed,
        )  # fmt: skip
        self._motion = self._checking = RailMove(self, None, asked=check)
        return self._motion

    def poll(self) -> float:
        """Begin the next leg of a check beside what else goes on, as a driver's thread does; when to look again, s."""
        if self._checking is not None and self._checking.done:
            self._checking = None
        return POLL_S

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

    def forget_zero(self) -> None:
        """The count can no longer be trusted."""
        self.homed = False

    def reset_fault(self, when: str) -> DeviceFault:
        """The fault of a module that was reset; told once."""
        self.lost_zero = False
        return DeviceFault(
            self.name, "rail.reset", f"the module has lost its zero {when}: it was reset or without power",
            recoverable=True, hint="Home the rail again; check the module's supply.",
        )  # fmt: skip

    def reset(self) -> None:
        """What is to happen to the module: it starts anew, and has forgotten its zero and its settings."""
        self.lost_zero, self.homed = self.homed or self.model.searching(self.clock.now()), False
        self.model.reset(self.clock.now())

    def _watch(self, length: float | None) -> CarriageWatch:
        return CarriageWatch(self.name, self.clock, length)

    def _set_up(self) -> None:
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
        run_up = run_up_distance(speed, self.setup.acceleration)
        ramp = math.copysign(run_up + SWEEP_MARGIN_M, stop - start)
        begin = check_range(self.name, "sweep start less its start-up", start - ramp, *self.travel, "m")
        return begin, check_range(self.name, "sweep stop plus its run-out", stop + ramp, *self.travel, "m")

    def _checked(self, speed: float) -> float:
        return check_range(self.name, "speed", speed, low=1e-9, high=self.setup.max_speed, unit="m/s")

    def _start(self, position: float, speed: float) -> int:
        """Send it there; the target in counts."""
        self._require_free()
        self._require_zero()
        target = round(position * self._counts)
        self._send(target, speed)
        return target

    def _require_zero(self) -> None:
        if self.lost_zero:
            raise self.reset_fault("since its last motion")
        if not self.homed:
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

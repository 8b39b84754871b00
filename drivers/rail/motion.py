"""Motions of the rail: how far and how long a ramp is, and the watch over a motion until it has ended.

A motion is watched by its own thread, which always ends: on arrival, on a fault, on a stop, or when the motion has
taken far longer than its ramp allows. `CarriageWatch` sees whether the carriage goes where it is sent while no zero
bounds it; `ZeroCheck` whether the count still has its zero where the reference switch is.
"""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from drivers.clock import Clock, timeout_of
from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, NotConnectedError, shown

SWEEP_MARGIN_M = 0.5e-3
"""Added to a sweep's ramp: takes up backlash and the rounding of the module's ramp."""
STANDSTILL_S = 0.5
"""A motor that has not moved for this long before its target has stalled."""
POLL_S = 0.010
POLL_WALL_S = 0.004


_TOO_SOON = 0.6
"""Of the least time that a motion can take; what comes sooner went faster than it was told."""
_JUDGED_S = 0.3
"""Motions that take less are not judged so: the way of a command and a poll count then."""
Readings = Sequence[tuple[float, float, float]]


def run_up_distance(speed: float, acceleration: float) -> float:
    """Distance in m in which a constant `acceleration` (m/s²) reaches `speed` (m/s) from rest: v² / 2a."""
    return speed * speed / (2.0 * acceleration)


def move_duration(distance: float, speed: float, acceleration: float) -> float:
    """Seconds of a trapezoidal move over `distance` m from rest to rest; triangular when too short for `speed`."""
    distance = abs(distance)
    if distance < 2.0 * run_up_distance(speed, acceleration):
        return 2.0 * math.sqrt(distance / acceleration)
    return distance / speed + speed / acceleration


class Stops:
    """The stops of one link: how many were asked for, and what became of the last."""

    def __init__(self) -> None:
        self.count = 0
        self.failed = False
        self._given = False

    @contextmanager
    def one_more(self) -> Iterator[None]:
        """The block gives the drive a stop; it has failed where it raises."""
        self.count += 1
        self._given = self.failed = True
        try:
            yield
            self.failed = False
        finally:
            self._given = False

    def end(self, name: str, position: float | None = None) -> bool:
        """How a motion ends that was stopped at `position`, m, or None in a search: not yet while it is given (False).
        Raises `Aborted` once it was taken, `DeviceFault` where nobody knows that it was."""
        if self._given:
            return False
        at = "" if position is None else f"at {shown(position, 'm')} "
        if self.failed:
            text = f"was told to stop and has not confirmed it; {at}it may go on"
            hint = "Press the emergency stop, then see the line to the drive."
            raise DeviceFault(name, "rail.not_stopped", text, recoverable=False, hint=hint)
        when = f"{at}before its target" if at else "while it searched the reference switch"
        raise Aborted(f"{name}: stopped {when}")


class RailMotion:
    """A running motion of the rail `name`.

    `arrived` is asked again and again: True ends the motion well, a `CellError` ends it with that error. `halt` stops
    the rail. `duration` is what the motion should take, in s of `clock`; it fails after twice that and 2 s, and when it
    has arrived far sooner than in the `least` time that its speed allows. `readings` are those of its way so far, as
    far as it is told: host time in s, position in m, round trip in s.
    """

    def __init__(
        self, name: str, clock: Clock, *, arrived: Callable[[], bool], halt: Callable[[], None], duration: float,
        least: float = 0.0, readings: Readings = (),
    ) -> None:  # fmt: skip
        self.readings = readings
        self._name = name
        self._clock = clock
        self._arrived = arrived
        self._halt = halt
        self._limit = clock.now() + timeout_of(clock, 2.0 * duration + 2.0)
        self._duration = duration
        self._least = least
        self._begun = clock.now()
        self._error: CellError | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=f"{name} motion", daemon=True)
        self._thread.start()

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        return self._ended.is_set()

    @property
    def error(self) -> CellError | None:
        """Why the motion failed, or None while it runs and when it arrived."""
        return self._error

    def wait(self, timeout: float) -> None:
        """Block until the motion has arrived; see `drivers.interfaces.Motion`."""
        if not self._clock.wait(self._ended, timeout_of(self._clock, timeout)):
            self._halt()
            raise DeadlineError(
                self._name,
                f"the motion has not ended within {timeout:.3g} s and was stopped; it should take "
                f"{self._duration:.3g} s. Check that the rail runs freely, or allow more time",
            )
        if self._error is not None:
            raise self._error

    def join(self, seconds: float) -> None:
        """Wait for the end of the watch, at most `seconds` on the wall, whatever the outcome."""
        self._thread.join(seconds)

    def _watch(self) -> None:
        period = max(POLL_S, POLL_WALL_S * self._clock.rate)
        try:
            due = self._clock.now()
            while not self._arrived():
                if self._clock.now() > self._limit:
                    raise DeviceFault(
                        self._name,
                        "rail.missed_target",
                        f"the motion should take {self._duration:.3g} s and has not ended after twice that",
                        recoverable=True,
                        hint="Check that the rail runs freely and that speed and acceleration suit the module.",
                    )
                due = max(due + period, self._clock.now())
                self._clock.sleep_until(due)
            taken = self._clock.now() - self._begun
            if self._least > _JUDGED_S and taken < _TOO_SOON * self._least:
                raise DeviceFault(
                    self._name,
                    "rail.too_fast",
                    f"was there after {taken:.3g} s, at its speed it takes {self._least:.3g} s at least",
                    recoverable=True,
                    hint="Check the lead, the steps or counts of a turn, and in which unit and order of words the "
                    "speed is written.",
                )
        except (Aborted, NotConnectedError) as error:
            self._error = error
        except CellError as error:
            self._error = error
            with suppress(CellError):
                self._halt()
        except Exception as error:
            self._error = DeviceFault(
                self._name, "rail.driver", f"{error!r}", recoverable=False, hint="Please report this as a defect."
            )
            with suppress(CellError):
                self._halt()
        finally:
            self._ended.set()


MARGIN_M = 0.010
"""So much farther than the travel a search may go: limit switches and ends lie beyond the travel."""
SEARCH_STANDSTILL_S = 1.0
"""A search in which the count stands for this long has a motor that does not follow; drives pause as they turn back."""
BEGINS_S = 2.0
"""The same before the first motion."""
SIDES = ("left", "right")


class CarriageWatch:
    """Judges readings of one motion of the rail `name`, in their order; without `length` only its switches.

    `length` is the travel in m. Each call takes the position in m, the left and the right limit switch, and what asks
    whether a stall was detected. Raises `DeviceFault`: rail.switches when the switch of the other side trips,
    rail.no_reference when it went farther than the travel and `MARGIN_M`, rail.stalled when it does not move.
    """

    def __init__(self, name: str, clock: Clock, length: float | None) -> None:
        self._name = name
        self._clock = clock
        self._length = length
        self._last: float | None = None
        self._moved, self._began = clock.now(), False
        self._low = self._high = 0.0
        self._side: int | None = None
        self._off = [False, False]
        """Of each switch: it was seen off since the carriage went this way."""

    def __call__(self, position: float, left: bool, right: bool, stalled: Callable[[], bool]) -> None:
        """Judge one reading."""
        last, self._last = self._last, position
        now = self._clock.now()
        if last is None or (self._length is not None and abs(position - last) > self._length):
            # The first reading, or the count was set anew.
            self._low = self._high = position
            return
        if position == last:
            self._require_motion(now, position, left, right, stalled)
            return
        self._moved, self._began = now, True
        side = int(position > last)
        if side != self._side:
            self._side, self._off = side, [False, False]
        other = 1 - side
        if (left, right)[other] and self._off[other]:
            raise DeviceFault(
                self._name,
                "rail.switches",
                f"the {SIDES[other]} limit switch tripped at {shown(position, 'm')} while the carriage was sent "
                f"{SIDES[side]}: the limit switches are exchanged, or the motor turns the other way",
                recoverable=False,
                hint="See which way the carriage goes. Swap the wires of the two limit switches, or turn rail.reversed "
                "round; then run `cell commission`.",
            )
        self._off = [off or not on for off, on in zip(self._off, (left, right), strict=True)]
        self._low, self._high = min(self._low, position), max(self._high, position)
        if self._length is not None and self._high - self._low > self._length + MARGIN_M:
            raise DeviceFault(
                self._name,
                "rail.no_reference",
                f"has searched its reference switch over {shown(self._high - self._low, 'm')} and not found it "
                f"(travel {shown(self._length, 'm')}, allowed {shown(self._length + MARGIN_M, 'm')}); "
                f"{_shown(left, right)}",
                recoverable=False,
                hint="Press each switch by hand and see what `cell jog` shows; check rail.reference_mode, rail.lead.",
            )

    def _require_motion(
        self, now: float, position: float, left: bool, right: bool, stalled: Callable[[], bool]
    ) -> None:
        if self._length is None:
            return
        detected = stalled()
        if detected or now - self._moved > timeout_of(self._clock, SEARCH_STANDSTILL_S if self._began else BEGINS_S):
            raise DeviceFault(
                self._name,
                "rail.stalled",
                f"the motor does not move in the search for the reference switch, at {shown(position, 'm')}"
                f"{' (stall detected)' if detected else ''}; {_shown(left, right)}",
                recoverable=False,
                hint="Look whether the carriage stands at an end: then its switches are exchanged or the motor turns "
                "the other way. Else see its current and its coupling.",
            )


def _shown(left: bool, right: bool) -> str:
    on = [side for side, state in zip(SIDES, (left, right), strict=True) if state]
    return f"the {' and the '.join(on)} limit switch shows" if on else "no limit switch shows"


LOST_M = 0.05e-3
"""By so much the switch's edge may lie beside 0: more is steps that were lost."""
AHEAD_M = 0.2e-3
"""So far before and behind 0 the carriage creeps."""
CREEP = 0.5e-3
"""Speed over the edge, m/s."""
SURE_M = 0.5 * LOST_M
"""Between two readings the edge is known to no more than the way between them: over a longer one the carriage creeps
once more, at half the speed."""
MOST_CREEPS = 3
LONGEST_S = (2**MOST_CREEPS - 1) * 2.0 * AHEAD_M / CREEP
"""What all the creeping may take."""

Arrived = Callable[[], bool]


class ZeroCheck:
    """Called again and again until it returns True: to `AHEAD_M` at `speed` m/s, over the edge, and to 0.

    `begin(position, speed)` sends the carriage, in m and m/s, and gives what asks whether it has arrived; `position`
    reads the count in m, `switch` the reference switch, on below 0. Raises `DeviceFault` (rail.lost_steps) after
    `forget`, which ends the trust in the zero, and what `begin` and its arrivals raise.
    """

    def __init__(
        self, name: str, begin: Callable[[float, float], Arrived], position: Callable[[], float],
        switch: Callable[[], bool], forget: Callable[[], None], speed: float,
    ) -> None:  # fmt: skip
        self._name = name
        self._begin, self._position, self._switch, self._forget = begin, position, switch, forget
        self._speed = speed
        self._arrived = begin(AHEAD_M, speed)
        self._stage = 0
        self._creeps = 0
        self._off_at = AHEAD_M
        """Count when the switch was off last, and when it was on first."""
        self._on_at = -AHEAD_M

    def __call__(self) -> bool:
        """Read, judge and go on."""
        if self._stage == 0:
            self._approach()
        elif self._stage == 1:
            self._creep()
        else:
            return self._arrived()
        return False

    def _approach(self) -> None:
        try:
            if not self._arrived():
                return
        except DeviceFault as fault:
            if fault.code != "rail.limit_switch":
                raise
            raise self._lost(f"a limit switch is hit on the way to {shown(AHEAD_M, 'm')}") from fault
        if self._switch():
            raise self._lost(f"its reference switch is on at {shown(AHEAD_M, 'm')} already")
        self._stage, self._arrived = 1, self._begin(-AHEAD_M, CREEP * 0.5**self._creeps)
        self._off_at, self._on_at = AHEAD_M, -AHEAD_M

    def _creep(self) -> None:
        before, on = self._position(), self._switch()
        if not on:
            self._off_at = before
            if self._arrived():
                raise self._lost(f"its reference switch is still off at {shown(-AHEAD_M, 'm')}")
            return
        self._on_at = max(self._on_at, self._position())
        if self._on_at > LOST_M or self._off_at < -LOST_M:
            raise self._lost(
                f"its reference switch went on between {shown(self._off_at, 'm')} and {shown(self._on_at, 'm')} by its "
                "count"
            )
        # The edge is passed: what is left of the way tells nothing more.
        if self._off_at - self._on_at > SURE_M and self._creeps + 1 < MOST_CREEPS:
            # Readings came too late to tell.
            self._creeps += 1
            self._stage, self._arrived = 0, self._begin(AHEAD_M, self._speed)
        elif self._off_at + self._on_at > 2 * LOST_M or self._off_at + self._on_at < -2 * LOST_M:
            raise self._lost(f"its reference switch went on about {shown(0.5 * (self._off_at + self._on_at), 'm')}")
        else:
            self._stage, self._arrived = 2, self._begin(0.0, self._speed)

    def _lost(self, what: str) -> DeviceFault:
        self._forget()
        return DeviceFault(
            self._name,
            "rail.lost_steps",
            f"has lost steps since it was homed: {what} (allowed 0 ± {shown(LOST_M, 'm')}). What it has measured "
            "meanwhile is of no use",
            recoverable=True,
            hint="Home the rail and sweep again. If it comes back: see whether the carriage jams or its cable pulls, "
            "raise the motor's current, lower rail.acceleration.",
        )

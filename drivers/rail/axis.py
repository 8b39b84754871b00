"""What linear axes on any stepper drive share: limits, one motion at a time, sweeps, stops that overtake, the end.

A make derives from it and says how its drive is asked and told.
"""

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import ClassVar

from drivers.clock import Clock
from drivers.errors import (
    Aborted,
    CellError,
    ConfigError,
    DeviceFault,
    InterlockError,
    NotConnectedError,
    check_positive,
    check_range,
    shown,
)
from drivers.interfaces import LONGEST_NUDGE_M, LinkStatistics
from drivers.last_words import LastWords, attended_by, descriptor_of
from drivers.ports import FAILURES, open_port
from drivers.rail.motion import (
    LONGEST_S,
    SWEEP_MARGIN_M,
    CarriageWatch,
    RailMotion,
    Stops,
    ZeroCheck,
    move_duration,
    run_up_distance,
)
from drivers.rail.sweep import RailSweep

_AT_START_M = 20e-6

Samples = list[tuple[float, float, float]]
"""Host time in s, position in m, round trip in s of each reading."""


QUIET_S = 0.05
"""Wall seconds without a byte after which a line is quiet."""


class RailLink(ABC):
    """The serial port `url` with one drive on it; a read waits for `timeout` wall seconds.

    `DRIVE` is what errors call it, `REPLY_S` the wall seconds that it has for a reply.

    A stop overtakes: commands that were issued before it and have not been sent yet are refused. Raises
    `NotConnectedError` when the port cannot be opened.
    """

    DRIVE: ClassVar[str]
    REPLY_S: ClassVar[float]

    def __init__(
        self, name: str, url: str, statistics: LinkStatistics, *, baud: int, timeout: float,
        parity: str = "none", stop_bits: int = 1,
    ) -> None:  # fmt: skip
        self.name = name
        self.url = url
        self.stops = Stops()
        """Those that were asked for: a command is only sent if none came since the caller read their count."""
        self._statistics = statistics
        self._timeout = timeout
        self._lock = threading.Lock()
        self._closed = False
        self._in_step = True
        self._last_words: LastWords | None = None
        self._port = open_port(name, url, baud=baud, timeout=timeout, parity=parity, stop_bits=stop_bits)

    @property
    def closed(self) -> bool:
        """True once `close` was called."""
        return self._closed

    @abstractmethod
    def stop(self) -> None:
        """Stop whatever the drive does; commands issued earlier are refused."""

    @abstractmethod
    def _stop_words(self) -> list[bytes]:
        """What stops the drive when this process dies."""

    def close(self) -> None:
        """Close the port; every later call raises `NotConnectedError`."""
        with self._lock:
            self._closed = True
            if self._last_words is not None:
                self._last_words.close()
            self._port.close()

    def attended(self) -> AbstractContextManager[Callable[[], None]]:
        """See `drivers.interfaces.Attended`."""
        return attended_by(self.name, self._stop_after_death())

    def _stop_after_death(self) -> LastWords | None:
        """From the first motion on: who never moved it has nothing to end."""
        port = descriptor_of(self._port)
        if self._last_words is None and port is not None:
            self._last_words = LastWords(self.name, port, self._stop_words())
        return self._last_words

    @contextmanager
    def _line(self, issued: int | None) -> Iterator[None]:
        """The line for this thread alone; `issued` is the count of stops when the caller decided to move, if it did.
        Raises `Aborted` when a stop came since, `DeviceFault` (rail.link_lost) when the port fails."""
        with self._lock:
            if self._closed:
                raise NotConnectedError(self.name, "the rail was closed. Open it again")
            if issued is not None and issued != self.stops.count:
                raise Aborted(f"{self.name}: stopped before the command was sent")
            try:
                yield
            except FAILURES as error:
                self._statistics.count("link_lost")
                raise DeviceFault(
                    self.name,
                    "rail.link_lost",
                    f"the port {self.url} failed: {error}",
                    recoverable=False,
                    hint=f"Check the cable and the {self.DRIVE}'s supply, then open the cell again.",
                ) from error

    def _rest(self) -> bytes:
        """What still comes in, until the line was quiet: thrown away, so that a late reply answers nothing else."""
        end = time.monotonic() + self.REPLY_S
        rest = b""
        self._port.timeout = QUIET_S
        try:
            # All that is there, and no more: it would wait for the rest of what was asked for, and a stop waits for it.
            while (more := bytes(self._port.read(max(1, min(256, self._port.in_waiting))))) and time.monotonic() < end:
                rest += more
        finally:
            self._port.timeout = self._timeout
        return rest


class RailAxis(ABC):
    """An axis of `travel` (low, high) in m, up to `max_speed` m/s at `acceleration` m/s², `counts` to a metre.

    With `control=False` the drive is only looked at: everything but reading is an `InterlockError`, and a motion that
    runs on it runs on. Raises `ConfigError` on impossible parameters.
    """

    _link: RailLink

    def __init__(
        self, name: str, clock: Clock, *, travel: tuple[float, float], max_speed: float, acceleration: float,
        counts: float, control: bool,
    ) -> None:  # fmt: skip
        for what, value in {"speed": max_speed, "acceleration": acceleration, "counts to a metre": counts}.items():
            if not value > 0:
                raise ConfigError(f"{name}: {what} {value} must be greater than 0. Correct it in the configuration")
        if not travel[0] < travel[1]:
            raise ConfigError(f"{name}: travel {travel} m must go from the lower to the higher limit. Correct it")
        self.name = name
        self.travel = travel
        self.statistics = LinkStatistics()
        self._clock = clock
        self._counts = counts
        self._max_speed = max_speed
        self._acceleration = acceleration
        self._control = control
        self._homing = False
        self._motion: RailMotion | None = None
        self._motion_issued = 0
        self._starting = threading.Lock()

    @abstractmethod
    def _position(self) -> float:
        """Read the position, m."""

    @abstractmethod
    def _require_zero(self) -> None:
        """Raise unless positions mean something: `InterlockError` when it was never homed."""

    @abstractmethod
    def _begin_homing(self, issued: int) -> float:
        """Set the drive up and start its search for the reference switch; what that should take, s."""

    @abstractmethod
    def _home_found(self, issued: int) -> bool:
        """Whether the search has ended at its zero; raises when it never will."""

    @abstractmethod
    def _send(self, position: float, speed: float, issued: int) -> None:
        """Send it to `position` m at `speed` m/s."""

    @abstractmethod
    def _arrival(self, position: float, issued: int, samples: Samples, *, homed: bool = True) -> Callable[[], bool]:
        """What is asked again and again whether it has arrived; appends its readings to `samples`. Where it was not
        begun `homed`, the zero is neither asked for nor given up."""

    @abstractmethod
    def _followed(self) -> tuple[float, bool, bool, Callable[[], bool]]:
        """Position in m, left and right limit switch, and what asks for a stall: as `CarriageWatch` takes them."""

    def home(self) -> RailMotion:
        """Search the reference switch; position 0 is there afterwards."""
        length = self.travel[1] - self.travel[0]
        with self._starting:
            issued = self._free()
            self._homing = True
            try:
                with self._halted_if_failed(issued):
                    duration = self._begin_homing(issued)
            except CellError:
                self._homing = False
                raise
            self._motion = RailMotion(
                self.name, self._clock, arrived=self._searched(issued, length), halt=self._halt(issued),
                duration=duration,
            )  # fmt: skip
            return self._motion

    def move_to(self, position: float, speed: float | None = None) -> RailMotion:
        """Move to `position` m at `speed` m/s (default the maximum); refused with `InterlockError` before homing."""
        check_range(self.name, "position", position, *self.travel, "m")
        speed = self._checked_speed("speed", self._max_speed if speed is None else speed)
        with self._starting:
            issued = self._free()
            duration, least = self._start(position, speed, issued)
            readings: Samples = []
            self._motion = RailMotion(
                self.name, self._clock, arrived=self._arrival(position, issued, readings), halt=self._halt(issued),
                duration=duration, least=least, readings=readings,
            )  # fmt: skip
            return self._motion

    def nudge(self, distance: float, speed: float) -> RailMotion:
        """Move by `distance` m, whether homed or not; see `drivers.interfaces.Nudged`."""
        check_range(self.name, "distance of a nudge", distance, low=-LONGEST_NUDGE_M, high=LONGEST_NUDGE_M, unit="m")
        speed = self._checked_speed("speed", speed)
        with self._starting:
            issued = self._free()
            goal = self._position() + distance
            with self._halted_if_failed(issued):
                self._send(goal, speed, issued)
            self._motion = RailMotion(
                self.name, self._clock, arrived=self._watched(self._arrival(goal, issued, [], homed=False), None),
                halt=self._halt(issued), duration=move_duration(distance, speed, self._acceleration),
            )  # fmt: skip
            return self._motion

    def _check_zero(self, switch: Callable[[], bool], forget: Callable[[], None]) -> RailMotion:
        """See `drivers.interfaces.ChecksZero`; `switch` reads the reference switch, `forget` gives the zero up."""
        with self._starting:
            issued = self._free()
            self._require_zero()
            duration = move_duration(self._position(), self._max_speed, self._acceleration)

            def begin(position: float, speed: float) -> Callable[[], bool]:
                self._send(position, speed, issued)
                return self._arrival(position, issued, [])

            self._motion = RailMotion(
                self.name,
                self._clock,
                arrived=ZeroCheck(self.name, begin, self._position, switch, forget=forget, speed=self._max_speed),
                halt=self._halt(issued),
                duration=duration + LONGEST_S,
            )
            return self._motion

    def sweep_start(self, start: float, stop: float, speed: float) -> float:
        """Where the rail has to stand before `sweep`: `start` less the start-up distance; `LimitError` if outside."""
        return self._sweep_ends(start, stop, speed)[0]

    def sweep(self, start: float, stop: float, speed: float) -> RailSweep:
        """Move so that the velocity is constant from `start` to `stop`; see `drivers.interfaces.Rail`."""
        begin, end = self._sweep_ends(start, stop, speed)
        record: Samples = []
        with self._starting:
            issued = self._free()
            self._require_zero()
            here = self._position()
            if abs(here - begin) > self._at_start():
                raise InterlockError(
                    self.name,
                    f"stands at {shown(here, 'm')}, the sweep starts at {shown(begin, 'm')}. "
                    "Move to sweep_start() first",
                )
            duration, _ = self._start(end, speed, issued)
            sweep = RailSweep(
                self.name, self._clock, start=start, stop=stop, speed=speed, resolution=1.0 / self._counts,
                record=record, arrived=self._arrival(end, issued, record), halt=self._halt(issued), duration=duration,
            )  # fmt: skip
            self._motion = sweep
            return sweep

    def stop(self) -> None:
        """Stop the motor now; every motion and every command still waiting ends with `Aborted`."""
        self._require_control()
        self._homing = False
        self._link.stop()

    def attended(self) -> AbstractContextManager[Callable[[], None]]:
        """While it is open, a helper stops the motor once it hears nothing; see `drivers.interfaces.Attended`."""
        self._require_control()
        return self._link.attended()

    def close(self) -> None:
        """Stop the motor, unless it is only looked at, and close the port."""
        if self._link.closed:
            return
        try:
            if self._control:
                self.stop()
        finally:
            self._link.close()
            if self._motion is not None:
                self._motion.join(2.0)

    def _at_start(self) -> float:
        """How far in m the rail may stand from where a sweep begins."""
        return _AT_START_M

    def _checked_speed(self, what: str, speed: float) -> float:
        return check_positive(self.name, what, speed, self._max_speed, "m/s")

    def _require_control(self) -> None:
        if not self._control:
            raise InterlockError(self.name, "was opened to be looked at only; nothing was sent. Open it for control")

    def _sweep_ends(self, start: float, stop: float, speed: float) -> tuple[float, float]:
        speed = self._checked_speed("sweep speed", speed)
        if start == stop:
            raise InterlockError(self.name, f"a sweep from {shown(start, 'm')} to the same place has no direction")
        ramp = math.copysign(run_up_distance(speed, self._acceleration) + SWEEP_MARGIN_M, stop - start)
        begin = check_range(self.name, "sweep start less its start-up", start - ramp, *self.travel, "m")
        end = check_range(self.name, "sweep stop plus its run-out", stop + ramp, *self.travel, "m")
        return begin, end

    def _free(self) -> int:
        """The count of stops to issue a motion under; `InterlockError` while another motion runs."""
        self._require_control()
        issued = self._link.stops.count
        if self._motion is not None and not self._motion.done:
            if self._link.stops.count != self._motion_issued:
                self._motion.join(2.0)
            if not self._motion.done:
                raise InterlockError(self.name, "another motion runs. Wait for it or stop() it first")
        self._motion_issued = issued
        return issued

    def _start(self, position: float, speed: float, issued: int) -> tuple[float, float]:
        """Send it there; the seconds that it should take, and those that `speed` alone takes, whatever the ramps."""
        self._require_zero()
        here = self._position()
        with self._halted_if_failed(issued):
            self._send(position, speed, issued)
        return move_duration(position - here, speed, self._acceleration), abs(position - here) / speed

    def _watched(self, arrived: Callable[[], bool], length: float | None) -> Callable[[], bool]:
        """`arrived`, with an eye on whether the carriage goes where it is sent."""
        watch = CarriageWatch(self.name, self._clock, length)

        def followed() -> bool:
            watch(*self._followed())
            return arrived()

        return followed

    def _searched(self, issued: int, length: float) -> Callable[[], bool]:
        """Whether the search has ended. What is read once a stop was asked for tells neither zero nor fault."""
        stops, watched = self._link.stops, self._watched(lambda: self._home_found(issued), length)

        def ended() -> bool:
            found = False
            if stops.count == issued:
                try:
                    found = watched()
                except CellError:
                    if stops.count == issued:
                        raise
            if stops.count == issued:
                return found
            # A reading from before the stop may have come after it.
            self._homing = False
            return stops.end(self.name)

        return ended

    @contextmanager
    def _halted_if_failed(self, issued: int) -> Iterator[None]:
        """A start whose reply was lost may have been taken: nobody would watch that motion."""
        try:
            yield
        except CellError as error:
            try:
                self._halt(issued)()
            except CellError as second:
                error.add_note(f"and it could not be stopped: {second}")
            raise

    def _halt(self, issued: int) -> Callable[[], None]:
        def halt() -> None:
            if self._link.stops.count == issued or self._link.stops.failed:
                self.stop()

        return halt

"""The rail: a linear axis on a TMCL stepper module that takes velocities in pulses per second.

Positions in m from the reference switch. Limits are checked before anything is sent; what arrives is checked against
what was asked for.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

from drivers.clock import Clock
from drivers.errors import Aborted, CellError, ConfigError, InterlockError
from drivers.interfaces import LONGEST_NUDGE_M, Identity, LinkStatistics, RailState, Reading
from drivers.quantities import check_positive, check_range, shown
from drivers.rail import health
from drivers.rail.arrival import Arrival, Samples
from drivers.rail.module import EXACT, SPEED, require_supported, set_checked, set_direction, set_ramp
from drivers.rail.motion import SWEEP_MARGIN_M, RailMotion, move_duration, run_up_distance
from drivers.rail.sweep import RailSweep
from drivers.rail.tmcl_codec import Axis, Reference
from drivers.rail.tmcl_link import NO_SUCH_TYPE, CommandRefused, TmclLink
from drivers.rail.zero import ZeroMark

_AT_START_M = 20e-6


class TmclRail:
    """A TMCL rail behind the serial port `url` (device path or pyserial URL).

    `lead` in m per turn, `travel` (low, high) in m, `max_speed` in m/s, `acceleration` in m/s²; `microsteps` per full
    step, a power of two up to 256. `reference_mode` is the module's axis parameter 193 (5: home switch in negative
    direction, turning round at the left limit switch). `reversed` turns the motor the other way round for a growing
    position (axis parameter 251). The module's serial number, if any, is its user variable 0.
    Every setting is read back; `DeviceFault` (rail.setting) when the module keeps another.
    A module that was homed under the same settings, and not reset since, stays homed.

    With `control=False` the module is only looked at: nothing on it is set, started or ended, by `close` neither, and a
    motion that runs on it runs on. Everything but reading is then an `InterlockError`.

    Raises `NotConnectedError` or `DeadlineError` when no module answers, `ConfigError` on impossible parameters and for
    a module that is not in `drivers.rail.module.SUPPORTED`.
    """

    def __init__(
        self,
        name: str,
        url: str,
        *,
        lead: float,
        steps_per_turn: int,
        microsteps: int,
        travel: tuple[float, float],
        max_speed: float,
        acceleration: float,
        address: int = 1,
        motor: int = 0,
        clock: Clock,
        baud: int = 9600,
        reference_mode: int = 5,
        reversed: bool = False,
        control: bool = True,
    ) -> None:
        positive = {"lead": lead, "steps per turn": steps_per_turn, "speed": max_speed, "acceleration": acceleration}
        _check_parameters(name, microsteps, travel, positive)
        self.name = name
        self.travel = travel
        self.statistics = LinkStatistics()
        self._clock = clock
        self._counts = steps_per_turn * microsteps / lead
        self._max_speed = max_speed
        self._acceleration = acceleration
        self._microsteps = microsteps
        self._reference_mode = reference_mode
        self._reversed = reversed
        self._control = control
        self._homing = False
        self._motion: RailMotion | None = None
        self._motion_issued = 0
        self._starting = threading.Lock()
        self._link = TmclLink(
            name, url, address=address, motor=motor, baud=baud, clock=clock, statistics=self.statistics
        )
        self._zero = ZeroMark(self._link, (lead, steps_per_turn, microsteps, motor, reference_mode, reversed))
        try:
            require_supported(name, self._link.firmware())
            self._zero.meet(microsteps.bit_length() - 1, reference_mode, mark=control)
            if control:
                self._set_up()
        except BaseException:
            self._link.close()
            raise

    def identity(self) -> Identity:
        """Model and firmware from the module's firmware text, serial number from its user variable 0."""
        firmware = self._link.firmware()
        serial = self._link.user_variable(0)
        return Identity(f"TMCM-{firmware.partition('V')[0]}", str(serial), firmware, self._link.url)

    def ping(self) -> float:
        """Read the position once; returns the round trip in wall seconds."""
        return self._clock.wall(self._link.get_stamped(Axis.POSITION)[2])

    def examine(self, seconds: float) -> list[Reading]:
        """What the module tells of its motor driver, at once; see `drivers.rail.health`."""
        try:
            return health.readings(self._link.get(Axis.DRIVER_ERRORS))
        except CommandRefused as refused:
            if refused.status == NO_SUCH_TYPE:
                return []
            raise

    def state(self) -> RailState:
        """Read position, velocity, switches and whether it is homed now.

        Raises `DeviceFault` (rail.reset), once, when the module has lost the zero that it had.
        """
        counts, stamp, _ = self._link.get_stamped(Axis.POSITION)
        velocity = self._link.get(Axis.VELOCITY) / self._counts
        return RailState(
            stamp=stamp,
            position=counts / self._counts,
            velocity=velocity,
            homed=(homed := not self._homing and self._zero.held()),
            homed_here=homed and self._zero.found_here,
            moving=velocity != 0.0 or self._homing,
            left_switch=bool(self._link.get(Axis.LEFT_SWITCH)),
            right_switch=bool(self._link.get(Axis.RIGHT_SWITCH)),
        )

    def home(self) -> RailMotion:
        """Search the reference switch; position 0 is there afterwards."""
        length = self.travel[1] - self.travel[0]
        with self._starting:
            issued = self._free()
            self._homing = True
            try:
                self._zero.searching(issued=issued)
                self._set_up()
                self._link.reference_search(Reference.START, issued=issued)
            except CellError:
                self._homing = False
                raise
            self._motion = RailMotion(
                self.name,
                self._clock,
                arrived=lambda: self._home_found(issued),
                halt=self._halt(issued),
                duration=length / (0.5 * self._max_speed) + 0.1 * length / (0.1 * self._max_speed),
            )
            return self._motion

    def move_to(self, position: float, speed: float | None = None) -> RailMotion:
        """Move to `position` m at `speed` m/s (default the maximum); refused with `InterlockError` before homing."""
        check_range(self.name, "position", position, *self.travel, "m")
        speed = check_positive(self.name, "speed", self._max_speed if speed is None else speed, self._max_speed, "m/s")
        with self._starting:
            issued = self._free()
            duration = self._start(position, speed, issued)
            self._motion = RailMotion(
                self.name,
                self._clock,
                arrived=self._arrival(position, issued, []),
                halt=self._halt(issued),
                duration=duration,
            )
            return self._motion

    def nudge(self, distance: float, speed: float) -> RailMotion:
        """Move by `distance` m, whether homed or not; see `drivers.interfaces.Nudged`."""
        check_range(self.name, "distance of a nudge", distance, -LONGEST_NUDGE_M, LONGEST_NUDGE_M, "m")
        speed = check_positive(self.name, "speed", speed, self._max_speed, "m/s")
        with self._starting:
            issued = self._free()
            here = self._link.get(Axis.POSITION)
            target = here + round(distance * self._counts)
            self._link.set(Axis.MAX_VELOCITY, self._pulses(speed), issued=issued)
            self._link.move_to(target, issued=issued)
            self._motion = RailMotion(
                self.name,
                self._clock,
                arrived=Arrival(
                    self._link, self._clock, target=target, counts=self._counts, issued=issued, samples=[], zero=None
                ),
                halt=self._halt(issued),
                duration=move_duration(distance, speed, self._acceleration),
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
            self._zero.require()
            here = self._link.get(Axis.POSITION) / self._counts
            if abs(here - begin) > _AT_START_M:
                raise InterlockError(
                    self.name,
                    f"stands at {shown(here, 'm')}, the sweep starts at {shown(begin, 'm')}. "
                    "Move to sweep_start() first",
                )
            duration = self._start(end, speed, issued)
            sweep = RailSweep(
                self.name,
                self._clock,
                start=start,
                stop=stop,
                speed=speed,
                resolution=1.0 / self._counts,
                record=record,
                arrived=self._arrival(end, issued, record),
                halt=self._halt(issued),
                duration=duration,
            )
            self._motion = sweep
            return sweep

    def stop(self) -> None:
        """Stop the motor now; every motion and every command still waiting ends with `Aborted`."""
        self._require_control()
        self._homing = False
        self._link.stop()

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

    def _require_control(self) -> None:
        if not self._control:
            raise InterlockError(self.name, "was opened to be looked at only; nothing was sent. Open it for control")

    def _pulses(self, value: float) -> int:
        return max(1, round(value * self._counts))

    def _sweep_ends(self, start: float, stop: float, speed: float) -> tuple[float, float]:
        speed = check_positive(self.name, "sweep speed", speed, self._max_speed, "m/s")
        if start == stop:
            raise InterlockError(self.name, f"a sweep from {shown(start, 'm')} to the same place has no direction")
        ramp = math.copysign(run_up_distance(speed, self._acceleration) + SWEEP_MARGIN_M, stop - start)
        begin = check_range(self.name, "sweep start less its start-up", start - ramp, *self.travel, "m")
        end = check_range(self.name, "sweep stop plus its run-out", stop + ramp, *self.travel, "m")
        return begin, end

    def _free(self) -> int:
        """The count of stops to issue a motion under; `InterlockError` while another motion runs."""
        self._require_control()
        issued = self._link.stops
        if self._motion is not None and not self._motion.done:
            if self._link.stops != self._motion_issued:
                self._motion.join(2.0)
            if not self._motion.done:
                raise InterlockError(self.name, "another motion runs. Wait for it or stop() it first")
        self._motion_issued = issued
        return issued

    def _arrival(self, position: float, issued: int, samples: Samples) -> Arrival:
        return Arrival(
            self._link,
            self._clock,
            target=round(position * self._counts),
            counts=self._counts,
            issued=issued,
            samples=samples,
            zero=self._zero,
        )

    def _set_up(self) -> None:
        """Tell the module what it forgets when it is reset."""
        set_direction(self._link, self._reversed)
        set_checked(self._link, Axis.MICROSTEP_RESOLUTION, self._microsteps.bit_length() - 1, EXACT)
        set_ramp(self._link, self._pulses(self._acceleration))
        set_checked(self._link, Axis.REFERENCE_MODE, self._reference_mode, EXACT)
        set_checked(self._link, Axis.REFERENCE_SEARCH_SPEED, self._pulses(0.5 * self._max_speed), SPEED)
        set_checked(self._link, Axis.REFERENCE_SWITCH_SPEED, self._pulses(0.1 * self._max_speed), SPEED)

    def _start(self, position: float, speed: float, issued: int) -> float:
        """Send it there; the seconds that it should take."""
        self._zero.require()
        here = self._link.get(Axis.POSITION) / self._counts
        self._link.set(Axis.MAX_VELOCITY, self._pulses(speed), issued=issued)
        self._link.move_to(round(position * self._counts), issued=issued)
        return move_duration(position - here, speed, self._acceleration)

    def _halt(self, issued: int) -> Callable[[], None]:
        def halt() -> None:
            if self._link.stops == issued:
                self.stop()

        return halt

    def _home_found(self, issued: int) -> bool:
        searching = self._link.reference_search(Reference.STATUS) != 0
        if self._link.stops != issued:
            raise Aborted(f"{self.name}: stopped while searching the reference switch")
        self._homing = searching
        if not searching:
            self._zero.found(issued=issued)
        return not searching


def _check_parameters(name: str, microsteps: int, travel: tuple[float, float], positive: dict[str, float]) -> None:
    for what, value in positive.items():
        if not value > 0:
            raise ConfigError(f"{name}: {what} {value} must be greater than 0. Correct it in the configuration")
    if microsteps not in (1, 2, 4, 8, 16, 32, 64, 128, 256):
        raise ConfigError(f"{name}: microsteps {microsteps} must be a power of two from 1 to 256. Correct it")
    if not travel[0] < travel[1]:
        raise ConfigError(f"{name}: travel {travel} m must go from the lower to the higher limit. Correct it")

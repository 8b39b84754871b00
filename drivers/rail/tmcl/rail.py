"""The rail: a linear axis on a TMCL stepper module that takes velocities in pulses per second.

Positions in m from the reference switch. Limits are checked before anything is sent; what arrives is checked against
what was asked for.
"""

from collections.abc import Callable

from drivers.clock import Clock
from drivers.interfaces import Identity, RailState, Reading
from drivers.rail.axis import RailAxis, Samples
from drivers.rail.motion import RailMotion
from drivers.rail.tmcl import module
from drivers.rail.tmcl.link import Axis, ReferenceSearch, TmclLink
from drivers.rail.tmcl.make import TmclRailConfig
from drivers.rail.tmcl.module import (
    EXACT,
    SPEED,
    STALL_FLAG,
    ArrivalWatch,
    ZeroMark,
    require_supported,
    set_checked,
    set_direction,
    set_ramp,
)

_HOME_SWITCH_ON_BELOW = (5, 7)
"""Reference modes whose zero is the edge below which the home switch is on."""


class TmclRail(RailAxis):
    """The rail that `record` describes, behind a TMCL module; the module's serial number is its user variable 0.

    Every setting is read back; `DeviceFault` (rail.setting) when the module keeps another.
    A module that was homed under the same settings, and not reset since, stays homed.

    With `control=False` the module is only looked at: nothing on it is set, started or ended, by `close` neither, and a
    motion that runs on it runs on. Everything but reading is then an `InterlockError`.

    Raises `NotConnectedError` or `DeadlineError` when no module answers, `ConfigError` on impossible parameters and for
    a module that is not in `drivers.rail.tmcl.module.SUPPORTED`.
    """

    def __init__(self, name: str, record: TmclRailConfig, *, clock: Clock, control: bool = True) -> None:
        super().__init__(
            name, clock, travel=record.travel, max_speed=record.max_speed, acceleration=record.acceleration,
            counts=record.steps_per_turn * record.microsteps / record.lead, control=control,
        )  # fmt: skip
        self._resolution = record.microsteps.bit_length() - 1
        self._reference_mode = record.reference_mode
        self._reversed = record.reversed
        self._link: TmclLink = TmclLink(
            name, record.url, address=record.address, motor=record.motor, baud=record.baud, clock=clock,
            statistics=self.statistics,
        )  # fmt: skip
        counted = record.lead, record.steps_per_turn, record.microsteps, record.motor
        self._zero = ZeroMark(self._link, (*counted, record.reference_mode, record.reversed))
        try:
            require_supported(name, self._link.firmware())
            self._zero.meet(self._resolution, self._reference_mode, mark=control)
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
        """What the module tells of its motor driver, at once; see `drivers.rail.tmcl.module`."""
        bits = self._link.get_if_there(Axis.DRIVER_ERRORS)
        return [] if bits is None else module.readings(bits)

    def state(self) -> RailState:
        """Read position, velocity, switches and whether it is homed now. Raises `DeviceFault` (rail.reset), once, when
        the module has lost the zero that it had."""
        counts, stamp, _ = self._link.get_stamped(Axis.POSITION)
        velocity = self._link.get(Axis.VELOCITY) / self._counts
        return RailState(
            stamp=stamp, position=counts / self._counts, velocity=velocity,
            homed=(homed := not self._homing and self._zero.held()), homed_here=homed and self._zero.found_here,
            moving=velocity != 0.0 or self._homing, left_switch=bool(self._link.get(Axis.LEFT_SWITCH)),
            right_switch=bool(self._link.get(Axis.RIGHT_SWITCH)),
        )  # fmt: skip

    def check_zero(self) -> RailMotion | None:
        """See `drivers.interfaces.ChecksZero`: where the zero is a home switch that is searched leftwards."""
        if self._reference_mode not in _HOME_SWITCH_ON_BELOW:
            return None
        return self._check_zero(lambda: bool(self._link.get(Axis.HOME_SWITCH)), self._zero.forget)

    def _position(self) -> float:
        return self._link.get(Axis.POSITION) / self._counts

    def _followed(self) -> tuple[float, bool, bool, Callable[[], bool]]:
        link = self._link
        left, right = (bool(link.get(switch)) for switch in (Axis.LEFT_SWITCH, Axis.RIGHT_SWITCH))
        return self._position(), left, right, self._stalled

    def _stalled(self) -> bool:
        return bool((self._link.get_if_there(Axis.EXTENDED_ERRORS) or 0) & STALL_FLAG)

    def _require_zero(self) -> None:
        self._zero.require()

    def _begin_homing(self, issued: int) -> float:
        self._zero.searching(issued=issued)
        self._set_up()
        self._link.reference_search(ReferenceSearch.START, issued=issued)
        # All of the travel at half the speed, and a tenth of it at a tenth.
        return 3.0 * (self.travel[1] - self.travel[0]) / self._max_speed

    def _home_found(self, issued: int) -> bool:
        searching = self._link.reference_search(ReferenceSearch.STATUS) != 0
        self._homing = searching
        if not searching:
            self._zero.found(issued=issued)
        return not searching

    def _send(self, position: float, speed: float, issued: int) -> None:
        set_checked(self._link, Axis.MAX_VELOCITY, self._pulses(speed), SPEED, issued=issued)
        self._link.move_to(round(position * self._counts), issued=issued)

    def _arrival(self, position: float, issued: int, samples: Samples, *, homed: bool = True) -> ArrivalWatch:
        return ArrivalWatch(
            self._link, self._clock, target=round(position * self._counts), counts=self._counts, issued=issued,
            samples=samples, zero=self._zero if homed else None,
        )  # fmt: skip

    def _set_up(self) -> None:
        set_direction(self._link, self._reversed)
        set_checked(self._link, Axis.MICROSTEP_RESOLUTION, self._resolution, EXACT)
        set_ramp(self._link, self._pulses(self._acceleration))
        set_checked(self._link, Axis.REFERENCE_MODE, self._reference_mode, EXACT)
        set_checked(self._link, Axis.REFERENCE_SEARCH_SPEED, self._pulses(0.5 * self._max_speed), SPEED)
        set_checked(self._link, Axis.REFERENCE_SWITCH_SPEED, self._pulses(0.1 * self._max_speed), SPEED)

    def _pulses(self, value: float) -> int:
        return max(1, round(value * self._counts))

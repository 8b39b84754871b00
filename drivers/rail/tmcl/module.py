"""What a TMCL module has to be, how it is set up, whether its zero still holds, and whether it has arrived.

Modules with a six-point ramp name their parameters 15, 16 and 19 in two orders. All three are set to 0, which switches
the first phase off in either order. Then only 5 and 17 are left, acceleration and deceleration. Every value is read
back, so that every motion is the trapezium that is reckoned with.

A homed module carries a mark: a user variable that a reset takes away, as variables from 56 on live in RAM only. As
long as the mark stands, the step counter has not been lost either. Its value names the settings that the counter is
read with, so that no program takes the zero of another one.

Source: TMCL firmware manual of the TMCM-1260; docs/reference/protocols.md, section 2.
"""

import logging
import re
import zlib
from dataclasses import dataclass

from drivers.clock import Clock, timeout_of
from drivers.errors import CellError, ConfigError, DeviceFault, InterlockError, shown
from drivers.interfaces import Reading
from drivers.rail.axis import Samples
from drivers.rail.motion import STANDSTILL_S
from drivers.rail.tmcl.link import NO_SUCH_TYPE, WRONG_VALUE, Axis, CommandRefused, TmclLink

SUPPORTED = ("1210", "1211", "1240", "1241", "1260", "1270", "1276", "1278", "6212", "6214")
"""Modules of the vendor with a six-point ramp that take speeds in pulses per second."""
STOP_SPEED = 10
"""Pulses per second at which the ramp may end: the smallest that the ramp's chip recommends."""
PULSES_MODE = 1
_ZERO_PHASE = (Axis.RAMP_15, Axis.RAMP_16, Axis.RAMP_19)


@dataclass(frozen=True)
class Rounding:
    """By how much a value that is read back may differ: `share` of it and `least` on top, since modules compute in
    units of their own."""

    share: float
    least: int

    def holds(self, wanted: int, found: int) -> bool:
        """Whether `found` is `wanted` but for rounding."""
        return abs(found - wanted) <= self.least + self.share * abs(wanted)


EXACT = Rounding(0.0, 0)
SPEED = Rounding(0.001, 2)
ACCELERATION = Rounding(0.01, 250)
"""One step of the ramp's chip is 116 pulses/s²."""


def require_supported(name: str, firmware: str) -> None:
    """Raise `ConfigError` when the firmware text, like 1260V112, is not that of a module that this driver knows."""
    told = re.fullmatch(r"(\d{4})V ?[\d.]{3,4}", firmware)
    if told is not None and told[1] in SUPPORTED:
        return
    known = ", ".join(f"TMCM-{model}" for model in SUPPORTED)
    raise ConfigError(
        f"{name}: the module says that its firmware is {firmware!r}; this driver knows {known}. Others count speeds in "
        "units of their own, so nothing was set and nothing moved. Correct rail.url or rail.address, or use a module "
        "of the list"
    )


def set_checked(link: TmclLink, axis: Axis, value: int, rounding: Rounding, *, issued: int | None = None) -> None:
    """Write an axis parameter and read it back; `DeviceFault` (rail.setting) when the module has another value. With
    `issued` it is not written after a stop."""
    link.set(axis, value, issued=issued)
    found = link.get(axis)
    if not rounding.holds(value, found):
        raise DeviceFault(
            link.name,
            "rail.setting",
            f"the module keeps {found} for axis parameter {int(axis)} instead of {value} "
            f"(allowed ±{rounding.least + rounding.share * abs(value):.0f})",
            recoverable=False,
            hint="See whether another program sets the module up, and whether rail.acceleration, rail.max_speed and "
            "rail.microsteps are in its range.",
        )


def set_ramp(link: TmclLink, acceleration: int) -> None:
    """Make positioning a trapezium of one `acceleration` (pulses/s²) both ways, and read back that it is. What a module
    does not have is left out: then there is nothing in it that bends the ramp."""
    # Some firmware knows units of its own as well, and says which in parameter 255.
    if link.get_if_there(Axis.UNIT_MODE) not in (None, PULSES_MODE):
        set_checked(link, Axis.UNIT_MODE, PULSES_MODE, EXACT)
    set_checked(link, Axis.MAX_ACCELERATION, acceleration, ACCELERATION)
    for axis in (Axis.MAX_DECELERATION, Axis.RAMP_18):
        _if_there(link, axis, acceleration, ACCELERATION)
    raised = False
    for axis in _ZERO_PHASE:
        try:
            _if_there(link, axis, 0, SPEED)
        except CommandRefused as refused:
            if refused.status != WRONG_VALUE or axis is Axis.RAMP_19 or raised:
                raise
            # A first acceleration that may not be 0: with its end speed at 0 it is not used. One of the two is the
            # acceleration, the other a speed: not both.
            set_checked(link, axis, acceleration, ACCELERATION)
            raised = True
    _if_there(link, Axis.STOP_VELOCITY, STOP_SPEED, SPEED)


def set_direction(link: TmclLink, reverse: bool) -> None:
    """Which way the motor turns for a growing position. `ConfigError` for a module that cannot turn it round."""
    try:
        set_checked(link, Axis.REVERSE_SHAFT, int(reverse), EXACT)
    except CommandRefused as refused:
        if refused.status not in (NO_SUCH_TYPE, WRONG_VALUE):
            raise
        if reverse:
            raise ConfigError(
                f"{link.name}: this module cannot reverse its motor (axis parameter {int(Axis.REVERSE_SHAFT)}): swap "
                "the two wires of one of the motor's coils, and write reversed = false"
            ) from refused


def _if_there(link: TmclLink, axis: Axis, value: int, rounding: Rounding) -> None:
    try:
        set_checked(link, axis, value, rounding)
    except CommandRefused as refused:
        if refused.status != NO_SUCH_TYPE:
            raise


TOO_HOT, SHORT_A, SHORT_B = 1 << 1, 1 << 3, 1 << 4
_ALARMS = (
    ("driver too hot", TOO_HOT, "Let it cool down; lower the motor's current, or give the module air."),
    ("short circuit of the motor", SHORT_A | SHORT_B, "Switch off, then measure the motor's cable and windings."),
)


def readings(driver_bits: int) -> list[Reading]:
    """One figure for each alarm in axis parameter 208, 1 where it is set. Open load is left out: a motor that stands
    shows it without cause."""
    return [Reading(what, float(bool(driver_bits & bits)), "", most=0.0, remedy=why) for what, bits, why in _ALARMS]


MARK_VARIABLE = 200
"""User variable that holds the mark: in RAM only."""
_NONE, _SEARCHING = 0, 1
STALL_FLAG = 1
_HOME_SWITCH_MODES = range(5, 9)
_MODE_BITS = 0x3F
"""Without the bits that swap the sides (64) and turn the home switch's polarity round (128)."""

_log = logging.getLogger(__name__)


class ZeroMark:
    """The mark on the module behind `link`. `settings` are what a position in counts depends on; a module set up by
    other ones is not homed for this program."""

    def __init__(self, link: TmclLink, settings: tuple[object, ...]) -> None:
        self._link = link
        self._value = zlib.crc32(repr(settings).encode()) % 0x7FFF_FFF0 + 2
        self._seen = False
        self._distrusted = False
        self.found_here = False
        """Whether this program saw the search end; what an earlier one found may be long ago."""

    def meet(self, microstep_resolution: int, reference_mode: int, *, mark: bool = True) -> None:
        """On connecting, before anything is set: take the mark away unless it is this program's and nothing speaks
        against it that happened while nobody watched: another resolution, a stall, a limit switch.

        Without `mark` the module is left as it is; its zero is not trusted here all the same.
        """
        link = self._link
        if link.user_variable(MARK_VARIABLE) == self._value:
            switches = (
                (Axis.LEFT_SWITCH, Axis.RIGHT_SWITCH) if reference_mode & _MODE_BITS in _HOME_SWITCH_MODES else ()
            )
            self._seen = not (
                link.get(Axis.MICROSTEP_RESOLUTION) != microstep_resolution
                or link.get(Axis.EXTENDED_ERRORS) & STALL_FLAG
                or any(link.get(switch) for switch in switches)
            )
            if not self._seen:
                _log.warning("%s: stalled, at a limit switch or set up anew since its homing; not homed", link.name)
        if mark and not self._seen:
            link.set_user_variable(MARK_VARIABLE, _NONE)
        self._distrusted = not mark and not self._seen

    def searching(self, *, issued: int) -> None:
        """A reference search begins: no zero until it has been found."""
        self._seen = self.found_here = False
        self._link.set_user_variable(MARK_VARIABLE, _SEARCHING, issued=issued)
        self._distrusted = False

    def found(self, *, issued: int) -> None:
        """The search has ended. `DeviceFault` (rail.reset) when the module was reset meanwhile: that, too, ends it."""
        if self._link.user_variable(MARK_VARIABLE) != _SEARCHING:
            raise self._lost("while it searched the reference switch")
        self._link.set_user_variable(MARK_VARIABLE, self._value, issued=issued)
        self._seen = self.found_here = True

    def held(self) -> bool:
        """Whether the module, asked now, counts from a zero that a homing of this configuration found. Raises
        `DeviceFault` (rail.reset), once, when it did before and does not any more."""
        if self._distrusted:
            return False
        held = self._link.user_variable(MARK_VARIABLE) == self._value
        if self._seen and not held:
            raise self._lost("since its last motion")
        self._seen = held
        return held

    def require(self) -> None:
        """Raise unless `held`: `InterlockError` when it was never homed."""
        if not self.held():
            raise InterlockError(self._link.name, "is not homed, so positions mean nothing yet. Call home() first")

    def require_still(self) -> None:
        """Raise `DeviceFault` (rail.reset) unless `held`: for a motion that began when it was."""
        if not self.held():
            raise self._lost("in its motion")

    def forget(self) -> None:
        """The count can no longer be trusted: neither by this program nor by another one."""
        self._seen, self._distrusted = False, True
        try:
            self._link.set_user_variable(MARK_VARIABLE, _NONE)
        except CellError as error:
            _log.warning("%s: the module could not be told that its zero is lost: %s", self._link.name, error)

    def _lost(self, when: str) -> DeviceFault:
        self._seen = False
        return DeviceFault(
            self._link.name,
            "rail.reset",
            f"the module has lost its zero {when}: it was reset or without power, or another program set it up",
            recoverable=True,
            hint="Home the rail again; check the module's supply.",
        )


_NEAR = 1
"""Counts off its target at which a module may come to rest, without saying that it has reached it."""
_DRIVER_FAULTS = {1: "driver too hot", 3: "short circuit in phase A", 4: "short circuit in phase B"}


class ArrivalWatch:
    """Watches one positioning to `target` (microsteps; `counts` microsteps per m), appending readings to `samples`.

    `issued` is the count of stops it was commanded under. `zero` is asked whether the count still holds, and told when
    it does not; None for a motion that needs none. Called again and again: True at the target, or at most one count off
    it at rest; raises `Aborted` after a stop, `DeviceFault` for rail.reset, rail.limit_switch, rail.missed_target and
    rail.stalled.
    """

    def __init__(
        self, link: TmclLink, clock: Clock, *, target: int, counts: float, issued: int, samples: Samples,
        zero: ZeroMark | None,
    ) -> None:  # fmt: skip
        self._link = link
        self._target = target
        self._counts = counts
        self._issued = issued
        self._samples = samples
        self._zero = zero
        self._standstill = timeout_of(clock, STANDSTILL_S)
        self._last: int | None = None
        self._moved = clock.now()

    def __call__(self) -> bool:
        """Read the position once and judge it."""
        position, stamp, round_trip = self._link.get_stamped(Axis.POSITION)
        self._samples.append((stamp, position / self._counts, round_trip))
        if self._link.stops.count != self._issued:
            return self._link.stops.end(self._link.name, position / self._counts)
        near = abs(position - self._target) <= _NEAR
        if near and (self._link.get(Axis.POSITION_REACHED) or (position == self._last and not self._moving())):
            # A module that was reset stands at its target, too, if that is 0.
            self._require_zero()
            return True
        if position != self._last:
            self._last, self._moved = position, stamp
        elif stamp - self._moved > self._standstill and not self._moving():
            raise self._failure(position)
        return False

    def _moving(self) -> bool:
        return self._link.get(Axis.VELOCITY) != 0

    def _failure(self, position: int) -> DeviceFault:
        link = self._link
        self._require_zero()
        short = (
            f"stands at {shown(position / self._counts, 'm')}, its target is {shown(self._target / self._counts, 'm')}"
        )
        side, switch = ("right", Axis.RIGHT_SWITCH) if self._target > position else ("left", Axis.LEFT_SWITCH)
        if link.get(switch):
            self._forget_zero()
            return DeviceFault(
                link.name, "rail.limit_switch", f"{short}: the {side} limit switch is hit", recoverable=True,
                hint="Home the rail again and check the configured travel.",
            )  # fmt: skip
        if link.get(Axis.TARGET_POSITION) != self._target:
            return DeviceFault(
                link.name, "rail.missed_target", f"{short}: somebody else changed the module's target",
                recoverable=True, hint="See what else commands this module.",
            )  # fmt: skip
        self._forget_zero()
        flags = link.get(Axis.DRIVER_ERRORS)
        reasons = [text for bit, text in _DRIVER_FAULTS.items() if flags >> bit & 1]
        if link.get(Axis.EXTENDED_ERRORS) & STALL_FLAG:
            reasons.append("stall detected")
        return DeviceFault(
            link.name,
            "rail.stalled",
            f"{short}: the motor does not move" + (f" ({', '.join(reasons)})" if reasons else ""),
            recoverable=True,
            hint="See whether the carriage is blocked and the motor has current, then home again.",
        )

    def _require_zero(self) -> None:
        if self._zero is not None:
            self._zero.require_still()

    def _forget_zero(self) -> None:
        if self._zero is not None:
            self._zero.forget()

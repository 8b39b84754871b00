"""What a module has to be and how its ramp has to be set, so that every motion is the trapezium that is reckoned with.

The vendor's modules with a six-point ramp name their parameters 15, 16 and 19 in two orders (first acceleration, its
end speed, start speed; or start speed, first acceleration, its end speed). All three are set to 0, which switches the
first phase off in either order; then only 5 and 17, acceleration and deceleration, are left. Every value is read back.

What a rail's module tells of its motor driver's health; it tells no voltage.

Source: docs/reference/protocols.md, section 2."""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.errors import ConfigError, DeviceFault
from drivers.interfaces import Reading
from drivers.rail.tmcl.codec import Axis
from drivers.rail.tmcl.link import NO_SUCH_TYPE, WRONG_VALUE, CommandRefused, TmclLink

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
    """Write an axis parameter and read it back; `DeviceFault` (rail.setting) when the module has another value.

    With `issued` it is not written after a stop.
    """
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
    """Make positioning a trapezium of one `acceleration` (pulses/s²) both ways, and read back that it is.

    What a module does not have is left out: then there is nothing in it that bends the ramp.
    """
    _in_pulses(link)
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


def _in_pulses(link: TmclLink) -> None:
    """Some firmware knows units of its own as well, and says which in parameter 255."""
    try:
        mode = link.get(Axis.UNIT_MODE)
    except CommandRefused as refused:
        if refused.status == NO_SUCH_TYPE:
            return
        raise
    if mode != PULSES_MODE:
        set_checked(link, Axis.UNIT_MODE, PULSES_MODE, EXACT)


TOO_HOT, SHORT_A, SHORT_B = 1 << 1, 1 << 3, 1 << 4
_ALARMS = (
    ("driver too hot", TOO_HOT, "Let it cool down; lower the motor's current, or give the module air."),
    ("short circuit of the motor", SHORT_A | SHORT_B, "Switch off, then measure the motor's cable and windings."),
)


def readings(driver_bits: int) -> list[Reading]:
    """One figure for each alarm in axis parameter 208, 1 where it is set.

    Open load is left out: a motor that stands shows it without cause.
    """
    return [Reading(what, float(bool(driver_bits & bits)), "", most=0.0, remedy=why) for what, bits, why in _ALARMS]

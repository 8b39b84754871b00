"""What a rail's module tells of its motor driver's health; it tells no voltage.

Source: docs/reference/protocols.md, section 2.
"""

from __future__ import annotations

from drivers.interfaces import Reading

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

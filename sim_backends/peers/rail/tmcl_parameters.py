"""Parameter tables of the simulated stepper module: number → value at power-on and allowed range.

Numbers and meanings are those of the TMCM-1260 with velocities in pps; 15 to 20 as the vendor's library has them.
"""

from __future__ import annotations

SETTINGS: dict[int, tuple[str, int, int]] = {
    4: ("max_velocity", 0, 7_999_774),
    5: ("max_acceleration", 0, 7_629_278),
    12: ("right_stop", 0, 1),
    13: ("left_stop", 0, 1),
    15: ("first_acceleration", 0, 7_629_278),
    16: ("first_speed", 0, 1_000_000),
    17: ("max_deceleration", 1, 7_629_278),
    18: ("last_deceleration", 1, 7_629_278),
    26: ("soft_stop", 0, 1),
    140: ("microsteps", 0, 8),
    193: ("search_mode", 1, 8),
    194: ("search_speed", 1, 7_999_774),
    195: ("switch_speed", 1, 7_999_774),
    251: ("reverse_shaft", 0, 1),
}
"""Axis parameters that set the motion: number → (setting, smallest, largest value)."""

SEARCH_MODES = (1, 2, 3, 4, 5, 6, 7)
"""Values of axis parameter 193 that this module knows."""

PLAIN: dict[int, tuple[int, int, int]] = {
    6: (128, 0, 255),
    7: (8, 0, 255),
    14: (0, 0, 1),
    19: (0, 0, 7_999_774),
    20: (10, 1, 7_999_774),
    21: (0, 0, 65535),
    24: (0, 0, 1),
    25: (0, 0, 1),
    31: (0, 0, 65535),
    127: (0, 0, 1),
    153: (0, 0, 13),
    154: (3, 0, 13),
    181: (0, 0, 7_999_774),
    204: (0, 0, 65535),
    214: (200, 0, 65535),
    254: (0, 0, 0),
    255: (1, 1, 1),
}
"""Axis parameters that are only remembered: number → (value at power-on, smallest, largest value)."""

GLOBALS: dict[int, tuple[int, int, int]] = {
    65: (0, 0, 11),
    66: (1, 1, 255),
    68: (0, 0, 65535),
    69: (8, 2, 8),
    70: (2, 0, 2047),
    71: (1, 0, 2047),
    73: (0, 0, 2**31 - 1),
    75: (0, 0, 255),
    76: (2, 0, 255),
    77: (0, 0, 1),
}
"""Global parameters of bank 0: number → (value at power-on, smallest, largest value)."""

EEPROM_LOCK, UNLOCK, LOCK = 73, 4321, 1234
"""The global parameter that locks the EEPROM, and its two values."""
USER_VARIABLES = 256
"""Number of variables in bank 2, all of them in RAM and 0 at power-on but for those that were stored."""
STORED_VARIABLES = 56
"""The first so many of them can be stored in the EEPROM, from where they come back at power-on."""
INPUTS = 4
"""Number of digital inputs."""

"""Limits with units: the checks that every driver makes before it sends anything.

Values are SI; the text of an error shows them in the units that people read off a machine (mm, degrees, ms).
"""

from __future__ import annotations

import math

from drivers.errors import LimitError

UNTOLD = "not told"
"""In place of a model, serial number or version that a device does not tell."""
_SHOWN = {
    "m": ("mm", 1e3),
    "m/s": ("mm/s", 1e3),
    "m/s^2": ("mm/s^2", 1e3),
    "rad": ("deg", 180.0 / math.pi),
    "rad/s": ("deg/s", 180.0 / math.pi),
    "rad/s^2": ("deg/s^2", 180.0 / math.pi),
    "s": ("ms", 1e3),
}


def shown(value: float, unit: str) -> str:
    """`value` in the SI unit `unit` as text for people: 0.12, "m" reads "120 mm"; other units are shown as given."""
    name, factor = _SHOWN.get(unit, (unit, 1.0))
    return f"{value * factor:.6g} {name}"


def check_range(device: str, what: str, value: float, low: float, high: float, unit: str) -> float:
    """Return `value` if low ≤ value ≤ high, all in the SI unit `unit`.

    Raises `LimitError` naming `what`, the value and the allowed range otherwise, NaN and infinity included.
    """
    number = float(value)
    if math.isfinite(number) and low <= number <= high:
        return number
    raise LimitError(
        device,
        f"{what} {shown(number, unit)} is outside {shown(low, unit)} to {shown(high, unit)}; nothing was sent. "
        f"Choose a {what} in this range.",
    )


def check_positive(device: str, what: str, value: float, high: float, unit: str) -> float:
    """Return `value` if 0 < value ≤ high, both in the SI unit `unit`; `LimitError` otherwise."""
    number = float(value)
    if math.isfinite(number) and 0.0 < number <= high:
        return number
    raise LimitError(
        device,
        f"{what} {shown(number, unit)} is outside 0 (excluded) to {shown(high, unit)}; nothing was sent. "
        f"Choose a {what} in this range.",
    )

"""Quantities with their unit, as configuration, jobs and the command line write them ("35 mm", "5 deg").

A bare number where a unit belongs is refused, and so is a value outside its allowed range, or a unit of another kind:
an angle is no frequency here. Inside the program everything is SI.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from pydantic import BeforeValidator, ValidationInfo

if TYPE_CHECKING:
    import pint

KEPT = "kept"
"""Context of a validation of what this program wrote itself: numbers are in base units then."""

_UNIT = r"[a-zA-Zµ°]{1,24}((\^|\*\*)[1-4])?"
_QUANTITY = re.compile(rf"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{{1,3}})?\s*({_UNIT}([/*]{_UNIT}){{0,3}})?", re.ASCII)

_USUAL = {
    "m": 1.0,
    "s": 1.0,
    "kg": 1.0,
    "N": 1.0,
    "Hz": 1.0,
    "m/s": 1.0,
    "m/s^2": 1.0,
    "mrad/m": 1e-3,
    "kbit/s": 1e3,
    "mm": 1e-3,
    "um": 1e-6,
    "nm": 1e-9,
    "ms": 1e-3,
    "mrad": 1e-3,
    "mm/s": 1e-3,
    "mm/s^2": 1e-3,
    "day": 86400.0,
    **dict.fromkeys(("deg", "deg/s", "deg/s^2", "deg/s^3"), math.pi / 180),
}
"""The units that files are mostly written in, in base units: they need no library, whose start takes half a second."""


@lru_cache(maxsize=1)
def _registry() -> pint.UnitRegistry[float]:
    import pint

    # Without a file at first: only then do later definitions count everywhere.
    registry: pint.UnitRegistry[float] = pint.UnitRegistry(
        None, autoconvert_offset_to_baseunit=True, on_redefinition="ignore"
    )
    registry.load_definitions(str(files("pint").joinpath("default_en.txt")))
    registry.default_system = "mks"
    # By itself the library takes both for plain numbers, and so "5 percent" for an angle and "5 Hz" for deg/s.
    registry.define("radian = [angle] = rad")
    registry.define("bit = [information]")
    return registry


def parse_quantity(text: object, unit: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Convert "35 mm" to a number of base units of `unit`, an SI magnitude.

    `low` and `high` are inclusive and given in `unit`, which is also the unit that an error is worded in. Raises
    `ValueError` with the value, the expected kind of unit and the allowed range.
    """
    allowed = range_text(low, high, unit)
    example = _example(unit, low, high)
    if isinstance(text, bool) or not isinstance(text, str):
        raise ValueError(f"{shown(text)} has no unit; write it as text with a unit, such as {example}{allowed}")
    match = _QUANTITY.fullmatch(text.strip().replace("μ", "µ"))
    if match is None:
        raise ValueError(f"{shown(text)} is not a number and a unit, such as {example}{allowed}")
    if match[3] is None:
        raise ValueError(f"{shown(text)} has no unit; write it with one, such as {example}{allowed}")
    try:
        if match[3] == unit and unit in _USUAL:
            shown_in_unit = float(text.strip()[: match.start(3)])
            value = shown_in_unit * _USUAL[unit]
        else:
            shown_in_unit, value = _converted(text.strip(), unit)
    except Exception as error:  # the library's parser raises whatever its tokens lead to
        raise ValueError(f"{shown(text)} is not a quantity in {unit}, such as {example}{allowed}") from error
    if not math.isfinite(shown_in_unit) or not low <= shown_in_unit <= high:
        raise ValueError(f"{shown(text)} is outside the allowed range{allowed}")
    return value


@lru_cache(maxsize=1024)
def _converted(text: str, unit: str) -> tuple[float, float]:
    """A quantity in `unit` and in base units. Kept, because a command reads the same files several times."""
    parsed: Any = _registry().Quantity(text)
    there = parsed.to(unit)
    return float(there.magnitude), float(there.to_base_units().magnitude)


def quantity(unit: str, low: float = -math.inf, high: float = math.inf) -> BeforeValidator:
    """Validator for a field of type float that is written with a unit; bounds as in `parse_quantity`."""

    def check(text: object, info: ValidationInfo) -> float:
        if info.context == KEPT and isinstance(text, float):
            return text
        return parse_quantity(text, unit, low, high)

    return BeforeValidator(check)


def number(low: float, high: float) -> BeforeValidator:
    """Validator for a field of type float that is a plain number from `low` to `high`."""

    def check(value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(
                f"{shown(value)} is no plain number{range_text(low, high)}; write it without quotes or unit"
            )
        if not low <= value <= high:
            raise ValueError(f"{shown(value)} is outside the allowed range{range_text(low, high)}")
        return float(value)

    return BeforeValidator(check)


def whole(low: int, high: int, *, allowed: tuple[int, ...] = (), meaning: str = "") -> BeforeValidator:
    """Validator for a field of type int from `low` to `high`, or one of `allowed`; `meaning` tells what they are."""
    text = f" (allowed: {', '.join(map(str, allowed))})" if allowed else range_text(low, high)

    def check(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"{shown(value)} is no whole number{text}{meaning}; write it without quotes or unit")
        if not low <= value <= high or (allowed and value not in allowed):
            raise ValueError(f"{shown(value)} is outside the allowed range{text}{meaning}")
        return value

    return BeforeValidator(check)


def shown(value: object) -> str:
    """A value as a file would show it, cut where it is long."""
    text = f'"{value}"' if isinstance(value, str) else str(value).lower() if isinstance(value, bool) else str(value)
    text = " ".join(text.split())
    return text if len(text) <= 60 else f"{text[:57]}…"


def range_text(low: float, high: float, unit: str = "") -> str:
    """The allowed range for a message, empty when there is none."""
    after = f" {unit}" if unit else ""
    if math.isinf(low) and math.isinf(high):
        return ""
    if math.isinf(high):
        return f" (at least {low:.10g}{after})"
    if math.isinf(low):
        return f" (at most {high:.10g}{after})"
    return f" (allowed: {low:.10g} to {high:.10g}{after})"


def _example(unit: str, low: float, high: float) -> str:
    value = low if math.isfinite(low) and low > 0 else min(1.0, high)
    return f'"{value:g} {unit}"'

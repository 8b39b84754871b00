"""Quantities with their unit, as configuration, jobs and the command line write them ("35 mm", "5 deg").

A bare number where a unit belongs is refused, and so is a value outside its allowed range. Inside the program
everything is SI.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from pydantic import BeforeValidator

if TYPE_CHECKING:
    import pint


_QUANTITY = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*[a-zA-Zµ°/^*0-9]*")


@lru_cache(maxsize=1)
def _registry() -> pint.UnitRegistry[float]:
    import pint

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)


def parse_quantity(text: object, unit: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Convert "35 mm" to a number of base units of `unit`, an SI magnitude.

    `low` and `high` are inclusive and given in `unit`, which is also the unit that an error is worded in. Raises
    `ValueError` with the value, the expected kind of unit and the allowed range.
    """
    import pint

    allowed = _range_text(unit, low, high)
    if isinstance(text, bool) or not isinstance(text, str):
        raise ValueError(
            f'{text!r} has no unit; write it as text with a unit, such as "{_example(unit, low)}"{allowed}'
        )
    if not _QUANTITY.fullmatch(text.strip()):
        raise ValueError(f'"{text}" is not a number and a unit, such as "{_example(unit, low)}"{allowed}')
    ureg = _registry()
    try:
        parsed: Any = ureg.Quantity(text.strip())
        if parsed.units == ureg.dimensionless and unit != "":
            raise ValueError(f'"{text}" has no unit; write it with one, such as "{_example(unit, low)}"{allowed}')
        shown = float(parsed.to(unit).magnitude)
        value = float(parsed.to(unit).to_base_units().magnitude)
    except (pint.errors.PintError, AttributeError, TypeError, AssertionError, SyntaxError) as error:
        raise ValueError(f'"{text}" is not a quantity in {unit}, such as "{_example(unit, low)}"{allowed}') from error
    if not math.isfinite(shown) or not low <= shown <= high:
        raise ValueError(f'"{text}" is outside the allowed range{allowed}')
    return value


def quantity(unit: str, low: float = -math.inf, high: float = math.inf) -> Any:
    """Pydantic validator for a field of type float that is written with a unit; bounds as in `parse_quantity`."""
    return BeforeValidator(lambda text: parse_quantity(text, unit, low, high))


def _range_text(unit: str, low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return ""
    if math.isinf(high):
        return f" (at least {low:g} {unit})"
    if math.isinf(low):
        return f" (at most {high:g} {unit})"
    return f" (allowed: {low:g} to {high:g} {unit})"


def _example(unit: str, low: float) -> str:
    return f"{low if math.isfinite(low) and low > 0 else 1:g} {unit}"

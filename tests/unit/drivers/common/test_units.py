"""Promises of `drivers.common.units`."""

from itertools import product

import numpy as np
import pytest

from drivers.common import units
from drivers.common.units import parse_quantity


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("35 mm", "mm", 0.035),
        ("5deg", "deg", np.deg2rad(5)),
        ("500 kbit/s", "kbit/s", 500_000.0),
        ("+0.1m", "mm", 0.1),
        ("-10 mm", "mm", -0.01),
        ("2 ms", "ms", 0.002),
        ("1e-3 m", "mm", 0.001),
        ("200 mm/s^2", "mm/s^2", 0.2),
    ],
)
def test_a_quantity_is_read_into_si(text: str, unit: str, expected: float):
    assert parse_quantity(text, unit) == pytest.approx(expected, rel=1e-12)


def test_the_usual_units_are_those_of_the_library_to_the_last_bit():
    for unit, number in product(units._USUAL, ("35", "0.1", "-7.3e-3", "+123456.789", ".6", "1e3")):
        text = f"{number} {unit}"
        assert parse_quantity(text, unit) == units._converted(text, unit)[1], text


@pytest.mark.parametrize(
    "text",
    [35, [35.0], True, "35", "35 kg", "mm", "", "5 mm; 3", "nan mm", "-1e999 mm", "2 mm^9^9^9", "5 furlongs/", None],
)  # fmt: skip
def test_anything_but_a_number_with_a_fitting_unit_is_refused(text: object):
    for limits in ((0, 100), ()):
        with pytest.raises(ValueError, match=r"unit|quantity|range"):
            parse_quantity(text, "mm", *limits)


def test_a_value_out_of_range_is_named_with_its_range():
    with pytest.raises(ValueError, match=r'"120 mm" is outside the allowed range \(allowed: 0 to 100 mm\)'):
        parse_quantity("120 mm", "mm", 0, 100)

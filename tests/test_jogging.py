"""What may be typed after `cell jog`."""

from __future__ import annotations

import math

import pytest

from cell.devices.jogging import Jog, parse_jog
from drivers.errors import ConfigError


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["rail", "+5mm"], Jog("rail", "", 0.005)),
        (["arm", "z", "-10mm"], Jog("arm", "z", -0.01)),
        (["arm", "j3", "+5deg"], Jog("arm", "j3", math.radians(5))),
        (["arm", "rx", "2", "deg"], Jog("arm", "rx", math.radians(2))),
        (["vehicle", "+0.1m"], Jog("vehicle", "x", 0.1)),
        (["vehicle", "-5deg"], Jog("vehicle", "yaw", math.radians(-5))),
    ],
)
def test_a_jog_is_read_with_its_unit(words: list[str], expected: Jog) -> None:
    wish = parse_jog(words[0], words[1:])
    assert (wish.device, wish.axis) == (expected.device, expected.axis)
    assert wish.amount == pytest.approx(expected.amount)


@pytest.mark.parametrize(
    "words",
    [["rail", "5"], ["rail"], ["arm", "+5mm"], ["arm", "j7", "5deg"], ["arm", "z", "5deg"], ["laser", "1mm"],
     ["rail", "+2m"], ["vehicle", "+5"], ["arm", "j3", "+5mm"]],
)  # fmt: skip
def test_anything_else_is_refused_with_examples(words: list[str]) -> None:
    with pytest.raises(ConfigError, match="write it like"):
        parse_jog(words[0], words[1:])

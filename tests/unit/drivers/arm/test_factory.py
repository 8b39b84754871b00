"""Promises of `drivers.arm.factory`."""

from __future__ import annotations

import struct

import pytest

from drivers.arm.factory import parse_kinematics_info


@pytest.mark.parametrize(("change", "reason"), [("short", "219 bytes, 220"), ("nan", "theta of a link table"),
                                                ("far", "d of a link table"),
                                                ("status", "not initialised; switch the arm on"),
                                                ("zeros", "not initialised; switch the arm on")])  # fmt: skip
def test_kinematics_info_that_is_none_is_refused(change: str, reason: str) -> None:
    numbers = [0.1] * 24
    if change == "nan":
        numbers[2] = float("nan")
    if change == "far":
        numbers[14] = 2e4
    if change == "zeros":
        numbers[6:18] = [0.0] * 12
    data = struct.pack(">6I24dI", *range(6), *numbers, 0 if change == "status" else 2)
    with pytest.raises(ValueError, match=reason):
        parse_kinematics_info(data[:219] if change == "short" else data)

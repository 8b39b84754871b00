"""Promises of `drivers.arm.factory`."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from drivers.arm.factory import flange_agrees, parse_kinematics_info, require_same_flange, same_payload
from drivers.errors import DeviceFault
from tests.support.wire.arm_bench import snapshot


@pytest.mark.parametrize(("change", "reason"), [("short", "219 bytes, 220"), ("nan", "theta of a link table"),
                                                ("far", "d of a link table"),
                                                ("status", "not initialised; switch the arm on"),
                                                ("zeros", "not initialised; switch the arm on")])  # fmt: skip
def test_kinematics_info_that_is_none_is_refused(change: str, reason: str):
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


@pytest.mark.parametrize(
    ("off", "agrees"),
    [
        ((0.04e-3, 0, 0, 0, 0, 0), True),
        ((0, -0.06e-3, 0, 0, 0, 0), False),
        ((0, 0, 0, 0.09e-3, 0, 0), True),
        ((0, 0, 0, 0, 0, -0.11e-3), False),
    ],
)
def test_another_arm_is_told_by_its_flange_in_place_and_in_turn(off, agrees):
    seen = replace(snapshot(0.0), flange=off)
    assert flange_agrees(lambda joints: np.zeros(6), seen) is agrees
    if agrees:
        require_same_flange("arm", lambda joints: np.zeros(6), seen)
        return
    with pytest.raises(DeviceFault, match="nothing was moved") as caught:
        require_same_flange("arm", lambda joints: np.zeros(6), seen)
    assert not caught.value.recoverable


@pytest.mark.parametrize(
    ("mass", "centre", "same"),
    [
        (2.0, (0.0, 0.0, 0.05), True),
        (2.01, (0.0, 0.0, 0.05), False),
        (1.99, (0.0, 0.0, 0.05), False),
        (2.0, (0.0, 0.001, 0.05), False),
        (2.0, (0.0, 0.0, -0.05), False),
    ],
)
def test_another_payload_is_told_by_its_mass_and_by_its_centre(mass, centre, same):
    seen = replace(snapshot(0.0), payload=(mass, centre))
    assert same_payload(seen, (2.0, (0.0, 0.0, 0.05))) is same
    assert same_payload(seen, (mass, (0.0, 0.0, 0.0)))  # a centre of zeros is none

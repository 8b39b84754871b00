"""Promises of `drivers.arm.feed`."""

from __future__ import annotations

import pytest

from drivers.arm.feed import safety_code


@pytest.mark.parametrize(
    ("bit", "code"),
    [
        (2, "arm.protective_stop"),
        (3, "arm.recovery_mode"),
        (4, "arm.safeguard_stop"),
        (5, "arm.emergency_stop"),
        (6, "arm.emergency_stop"),
        (7, "arm.emergency_stop"),
        (8, "arm.safety_fault"),
        (9, "arm.safety_fault"),
        (10, "arm.safeguard_stop"),
    ],
)
def test_safety_bits_have_the_makers_meaning(bit, code):
    # docs/reference/protocols.md, section 1
    assert safety_code(1 << bit) == code
    assert safety_code(1) == ""


def test_an_emergency_stop_outranks_a_protective_stop():
    assert safety_code(1 << 2 | 1 << 6) == "arm.emergency_stop"

"""Promises of `drivers.arm.faults`."""

from __future__ import annotations

from drivers.arm.faults import fault


def test_only_some_faults_can_be_cleared_by_the_driver():
    assert fault("arm", "arm.protective_stop").recoverable
    assert not fault("arm", "arm.emergency_stop").recoverable
    assert "release the button" in str(fault("arm", "arm.emergency_stop"))

"""Promises of `drivers.arm.faults`."""

import pytest

from drivers.arm.faults import fault, unlock
from drivers.clock import Clock
from drivers.errors import Aborted, DeviceFault


def test_only_some_faults_can_be_cleared_by_the_driver():
    assert fault("arm", "arm.protective_stop").recoverable
    assert not fault("arm", "arm.emergency_stop").recoverable
    assert "release the button" in str(fault("arm", "arm.emergency_stop"))


@pytest.mark.parametrize("known", ["safetystatus", "safetymode"])
@pytest.mark.parametrize(
    ("status", "why"),
    [
        ("REDUCED", ""),
        ("PROTECTIVE_STOP", "a person confirms"),
        ("RECOVERY", "outside its safety limits"),
        ("SYSTEM_THREE_POSITION_ENABLING_STOP", "the safeguard is open"),
        ("VIOLATION", "reports a fault"),
    ],
)
def test_reduced_mode_is_no_fault_and_a_protective_stop_needs_a_person(dashboard, status, why, known):
    """Before PolyScope 5.4 a controller knows only the safety mode."""
    told = {known: f"Safetystatus: {status}"}
    board, asked = dashboard(lambda question: told.get(question, f"could not understand: '{question}'"))
    if not why:
        unlock("arm", board, Clock(), False, lambda: None)
    else:
        with pytest.raises(DeviceFault, match=why):
            unlock("arm", board, Clock(), False, lambda: None)
    assert asked == ["safetystatus", "safetymode"][: 1 if known == "safetystatus" else 2]
    board.close()


def test_a_stop_that_comes_before_a_protective_stop_is_unlocked_leaves_it_locked(dashboard):
    def stopped():
        raise Aborted("stopped meanwhile")

    board, asked = dashboard(lambda question: "Safetystatus: PROTECTIVE_STOP")
    with pytest.raises(Aborted, match="meanwhile"):
        unlock("arm", board, Clock(), True, stopped)
    board.close()
    assert asked == ["safetystatus"]

"""Promises of `drivers.arm.faults`."""

from __future__ import annotations

import threading

import pytest

from drivers.arm.dashboard import Dashboard
from drivers.arm.faults import fault, unlock
from drivers.clock import Clock
from drivers.errors import Aborted, DeviceFault


def test_only_some_faults_can_be_cleared_by_the_driver():
    assert fault("arm", "arm.protective_stop").recoverable
    assert not fault("arm", "arm.emergency_stop").recoverable
    assert "release the button" in str(fault("arm", "arm.emergency_stop"))


def dashboard_of(server, status):
    """A connected dashboard, and what it asks; `status` answers a question, None: that it is not understood."""
    asked = []

    def serve():
        client, _ = server.accept()
        with client:
            client.sendall(b"Connected\n")
            for question in client.makefile("rb"):
                asked.append(question.decode().strip())
                told = status(asked[-1])
                reply = f"could not understand: '{asked[-1]}'" if told is None else f"Safetystatus: {told}"
                client.sendall(f"{reply}\n".encode())

    threading.Thread(target=serve, daemon=True).start()
    return Dashboard("arm", server.getsockname()[0]), asked


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
def test_reduced_mode_is_no_fault_and_a_protective_stop_needs_a_person(server, status, why, known):
    """Before PolyScope 5.4 a controller knows only the safety mode."""
    dashboard, asked = dashboard_of(server, lambda question: status if question == known else None)
    if not why:
        unlock("arm", dashboard, Clock(), False, lambda: None)
    else:
        with pytest.raises(DeviceFault, match=why):
            unlock("arm", dashboard, Clock(), False, lambda: None)
    assert asked == ["safetystatus", "safetymode"][: 1 if known == "safetystatus" else 2]
    dashboard.close()


def test_a_stop_that_comes_before_a_protective_stop_is_unlocked_leaves_it_locked(server):
    def stopped():
        raise Aborted("stopped meanwhile")

    dashboard, asked = dashboard_of(server, lambda question: "PROTECTIVE_STOP")
    with pytest.raises(Aborted, match="meanwhile"):
        unlock("arm", dashboard, Clock(), True, stopped)
    dashboard.close()
    assert asked == ["safetystatus"]

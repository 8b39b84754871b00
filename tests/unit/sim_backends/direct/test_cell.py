"""Time on the virtual clock passes while somebody waits, and only then."""

from __future__ import annotations

import pytest

from sim_backends.clock import SteppedClock


def test_stepped_time_never_runs_back():
    clock = SteppedClock()
    clock.step_to(2.0)
    assert clock.now() == 2.0
    with pytest.raises(ValueError, match="backwards"):
        clock.step_to(1.0)


def test_waiting_lets_just_that_much_time_pass(cell):
    before = cell.clock.now()
    cell.clock.sleep(0.123)
    assert cell.clock.now() == pytest.approx(before + 0.123, abs=1e-12)
    assert cell.world.arm.time == pytest.approx(before + 0.123, abs=1e-12)

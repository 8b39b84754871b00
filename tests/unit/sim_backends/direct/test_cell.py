"""Time on the virtual clock passes while somebody waits, and only then."""

import pytest

from sim_backends.clock import SteppedClock


def test_stepped_time_never_runs_back():
    clock = SteppedClock()
    clock.step_to(2.0)
    assert clock.now() == 2.0
    with pytest.raises(ValueError, match="backwards"):
        clock.step_to(1.0)

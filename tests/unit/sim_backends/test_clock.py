"""The world's clock, and the recent past of moving bodies."""

import numpy as np
import pytest

from sim_backends.clock import History, WorldClock
from tests.support.simulator.optics_scene import pose as turned


def test_a_fast_clock_reaches_a_time_that_many_times_sooner():
    slow, fast = WorldClock(1.0), WorldClock(50.0)
    fast.sleep_until(1.0)
    assert fast.now() >= 1.0
    assert slow.now() == pytest.approx(fast.now() / 50.0, rel=0.2)


def test_history_interpolates_a_screw_motion_and_holds_its_ends():
    history = History()
    for t in np.arange(0.0, 2.0, 0.1):
        history.append(t, turned((0.0, 0.0, 0.5 * t), (t, 0.0, 0.0)))
    expected = turned((0.0, 0.0, 0.5 * 1.234), (1.234, 0.0, 0.0))
    assert history.at(1.234) == pytest.approx(expected, abs=1e-12)
    assert history.at(-1.0) == pytest.approx(history.at(0.0))
    assert history.at(99.0) == pytest.approx(history.at(1.9))


def test_history_forgets_what_is_older_than_it_keeps():
    history = History(keep=1.0)
    for t in np.arange(0.0, 5.0, 0.01):
        history.append(t, turned((0, 0, 0), (t, 0, 0)))
    assert history.at(0.0)[0, 3] == pytest.approx(4.0, abs=0.02)
    assert (history.at(4.005)[0, 3], history.at(4.985)[0, 3]) == (pytest.approx(4.005), pytest.approx(4.985))

"""Promises of `cell.procedures.sweep.swath`."""

import numpy as np
import pytest

from cell.procedures.sweep.swath import SweepErrors, TimeBound, shift_by_times, step_of_clock


def test_only_what_pace_and_arrival_both_tell_is_a_step_of_the_clock():
    rng, numbers = np.random.default_rng(0), np.arange(100)
    true, late = 1e5 + numbers / 30.0, rng.exponential(0.004, 100)
    stepped = true + 0.012 * (numbers >= 60)
    assert step_of_clock(numbers, stepped, true + late) == pytest.approx(0.012, abs=0.004)
    assert step_of_clock(numbers, 2 * true - stepped, true + late) == pytest.approx(-0.012, abs=0.004)
    # A machine that was busy for a while, a camera that paused, lost pictures, stamps that scatter.
    busy = late + 0.05 * (numbers >= 60)
    paused = true + 0.05 * (numbers >= 60)
    some = np.delete(numbers, slice(40, 46))
    noisy = true + 0.002 * rng.standard_normal(100)
    for times, arrived, kept in (
        (true, true + busy, numbers),
        (paused, paused + late, numbers),
        (true, true + late, some),
        (noisy, true + late, numbers),
    ):
        assert abs(step_of_clock(kept, times[kept], arrived[kept])) < 0.003
    assert step_of_clock(numbers[:9], stepped[55:64], true[55:64]) == 0.0


def test_what_times_leave_open_adds_up_for_the_shift_and_by_squares_for_its_variance():
    errors = SweepErrors(np.eye(6), 1e-5, 1e-4, late=2e-3)
    known = [TimeBound("rail", "rail", 1e-3), TimeBound("scan_camera", "camera", 2e-3)]
    assert shift_by_times(known, 0.01, errors) == pytest.approx((3e-5, 0.01**2 * (1e-6 + 4e-6 + 4e-6) / 3))

"""A repeated sweep is slower, with its lines as close as before."""

from __future__ import annotations

import pytest

from cell.config.job import load_job
from cell.procedures.steps.laser_sweep import unhurried


@pytest.mark.parametrize(("attempt", "share"), [(1, 1.0), (2, 0.5), (3, 0.25)])
def test_each_repetition_is_half_as_fast_with_the_lines_as_close(attempt: int, share: float) -> None:
    scan = load_job("pot")[0].scan
    again = unhurried(scan, attempt)
    assert again.speed == pytest.approx(share * scan.speed)
    assert again.speed / again.frame_rate == pytest.approx(scan.speed / scan.frame_rate)
    assert again.length == scan.length

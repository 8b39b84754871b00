"""A scan head that slipped since the calibration, and pictures that come later, are seen on the plate on the claw."""

from __future__ import annotations

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.measure.calibration.drift.slip import LARGEST_LAG_S, LARGEST_M, NOTED_M, Slip
from drivers.errors import RefusedError

CONFIG = load_config(None)


def test_what_is_small_is_silent_what_is_more_is_stated_and_the_rest_is_refused() -> None:
    axes = np.eye(3)[[1, 2, 0]]
    small, some, far = (Slip(size, 0.0, 0.0) for size in (0.9 * NOTED_M, 1.5 * NOTED_M, 1.1 * LARGEST_M))
    assert small.notes == () and not small.covariance(axes).any()
    assert "slipped by +0.075 mm along" in some.notes[0]
    # In the base, along the camera's x axis, and no less than the plate shows.
    assert np.sqrt(np.diag(some.covariance(axes))[2]) >= 1.5 * NOTED_M
    # A head that turned on its mount, 85 mm before the plate.
    assert np.sqrt(np.diag(some.covariance(axes))[3:]) == pytest.approx(3 * [1.5 * NOTED_M / 0.085])
    small.require(), some.require()
    with pytest.raises(RefusedError, match=r"scan head has slipped by \+0\.165 mm along"):
        far.require()
    for along, across in ((-1.1, 0.0), (0.0, 1.1), (0.0, -1.1), (-0.8, 0.8), (np.nan, 0.0), (0.0, np.nan)):
        with pytest.raises(RefusedError, match="scan head has slipped"):
            Slip(along * LARGEST_M, across * LARGEST_M, 0.0).require()
    for lag in (-1.1 * LARGEST_LAG_S, 1.1 * LARGEST_LAG_S, np.nan):
        with pytest.raises(RefusedError, match="later"):
            Slip(0.0, 0.0, lag).require()

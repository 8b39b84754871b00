"""Light that falls off moves no chessboard corner."""

import numpy as np
import pytest
from scipy.special import erf

from cell.measure.vision.board.corners import fit_corners
from tests.unit.cell.measure.vision.board.drawn_boards import BRIGHT, DARK, MOST_MOVED_PX, PSF, SLOPES, uneven_picture


@pytest.mark.parametrize("slope", SLOPES)
def test_light_that_falls_off_moves_no_corner(slope):
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(30):
        x, y = 64 + rng.uniform(-0.5, 0.5, 2)

        def crossing(u, v, x=x, y=y):
            a, b = (-(u - x) * 0.3 + (v - y)), ((u - x) + (v - y) * 0.3)
            half = 0.5 * (BRIGHT - DARK)
            return 0.5 * (BRIGHT + DARK) - half * erf(a / 1.044 / PSF / 1.414) * erf(b / 1.044 / PSF / 1.414)

        steps = 40.0 * np.array([[[1.0, -0.3], [0.3, 1.0]]])
        uneven, even = (
            fit_corners(uneven_picture(crossing, g), np.array([[64.0, 64.0]]), steps, np.array([True]))[0][0]
            for g in (slope, (0.0, 0.0))
        )
        assert np.linalg.norm(even - (x, y)) < 0.02
        errors.append(uneven - even)
    assert np.abs(np.mean(errors, axis=0)).max() < MOST_MOVED_PX

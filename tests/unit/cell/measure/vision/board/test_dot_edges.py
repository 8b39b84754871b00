"""Promises of a dot's edge, on dots drawn from a formula."""

import numpy as np
import pytest
from scipy.special import ndtr

from cell.measure.vision.board.dots import measure_dots
from cell.measure.vision.board.lattice import Blobs


def drawn(x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:64, :64]
    return 200.0 - 160.0 * ndtr(radius - np.hypot(columns - x, rows - y))


@pytest.mark.parametrize("aside", [-4.0, 0.0, 6.0])
def test_a_laser_line_across_a_dot_moves_its_centre_by_little(aside):
    dot, columns = drawn(31.3, 30.8, 12.0), np.arange(64)
    line = 150.0 * np.exp(-0.5 * ((columns - 31.3 - aside) / 1.5) ** 2)
    start = Blobs(np.array([[31.0, 31.0]]), 12.5 * np.eye(2)[None])
    for picture in (dot, np.minimum(dot + line, 255.0)):
        found, sigma = measure_dots(np.rint(picture).astype(np.uint8), start)
        assert np.abs(found.centres[0] - (31.3, 30.8)).max() < 0.06 and sigma[0] < 0.1


def test_where_a_guess_is_no_place_of_the_picture_no_dot_is_measured():
    picture = np.rint(drawn(31.3, 30.8, 12.0)).astype(np.uint8)
    guesses = np.array([[31.0, 31.0], [np.nan, 31.0], [np.inf, 31.0], [1e300, -1e300], [5.0, 60.0]])
    with np.errstate(invalid="ignore", over="ignore"):
        _, sigma = measure_dots(picture, Blobs(guesses, np.repeat(12.5 * np.eye(2)[None], 5, axis=0)))
    assert np.isfinite(sigma).tolist() == [True, False, False, False, False]

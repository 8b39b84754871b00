"""Promises of chessboards in pictures."""

from __future__ import annotations

import numpy as np
import pytest

from cell.measure.vision import find_board, parse_board
from sim_backends.optics.scene import LaserOptics
from tests.unit.cell.measure.vision.board.drawn_boards import FINE, SCAN, photograph, placed, true_pixels


@pytest.mark.parametrize("text", [FINE, "chessboard:11x8:3mm"])
def test_a_laser_line_across_the_board_does_no_harm(text):
    pose = placed(text, 0.130, 10)
    view = find_board(photograph(SCAN, text, pose, LaserOptics(brightness=4e5)), parse_board(text))
    error = np.linalg.norm(view.pixels - true_pixels(SCAN, pose, view), axis=1)
    assert len(view.ids) > 0.7 * len(view.spec.lattice())
    assert np.median(error) < 0.08
    assert error.max() < 1.0

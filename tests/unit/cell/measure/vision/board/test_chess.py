"""Promises of chessboards in pictures."""

import numpy as np
import pytest

from cell.measure.vision.board.board import find_board
from cell.measure.vision.board.view import parse_board
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


@pytest.mark.parametrize("text", ["chessboard:6x6:3mm", "chessboard:7x7:3mm", "chessboard:4x4:5mm"])
def test_a_square_board_is_found_in_one_of_the_orders_that_it_may_have(text):
    """A quarter turn of an even one looks the same."""
    pose = placed(text, 0.130, 10)
    view = find_board(photograph(SCAN, text, pose), parse_board(text))
    off = [np.linalg.norm(turn.pixels - true_pixels(SCAN, pose, turn), axis=1).max() for turn in view.turns()]
    assert view.order_assumed and len(off) == (2 if "7x7" in text else 4)
    assert sum(far < 1.0 for far in off) == 1

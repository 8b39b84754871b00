"""A calibration view that misses the board is taken again from where the earlier views say that the board is."""

import numpy as np
import pinocchio as pin
import pytest

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import load_config
from cell.measure.geometry.poses import difference, from_parts, perturbed
from cell.measure.vision.board.view import BoardView, parse_board
from cell.procedures.arm.photograph import CalibrationView, scan_calibration_views
from cell.procedures.calibrate.boards import SEARCH_M, Aim

CONFIG = load_config(None)
CAMERA = nominal_camera(CONFIG.scan_camera)
BOARD = parse_board(CONFIG.calibration.fine.board)
VIEWS = scan_calibration_views(CONFIG, BOARD)
DRAWN_HAND, DRAWN_BOARD = CONFIG.scan_camera.flange_from_camera.se3(), CONFIG.calibration.fine.base_from_board.se3()
HAND = perturbed(DRAWN_HAND, (0.006, -0.008, 0.004, 0.03, -0.02, 0.04))
PLACE = perturbed(DRAWN_BOARD, (-0.007, 0.005, 0.003, 0.02, 0.01, -0.03))


def seen_from(view: CalibrationView, hand: pin.SE3, board: pin.SE3) -> pin.SE3:
    """camera_from_board at a view."""
    return (view.base_from_flange * hand * from_parts((view.rail_position, 0, 0))).inverse() * board


def show(aim: Aim, view: CalibrationView) -> None:
    """Let the true camera see the true board there."""
    points = BOARD.points()
    pixels = CAMERA.project(np.array([seen_from(view, HAND, PLACE).act(p) for p in points]))
    size = (CONFIG.scan_camera.width, CONFIG.scan_camera.height)
    aim.learn(
        BoardView(BOARD, size, np.arange(len(points)), pixels, np.full(len(points), 0.05), dot_radius=0.0),
        view.base_from_flange,
        view.rail_position,
    )


def test_the_same_view_is_right_after_one_that_was_like_it():
    aim = Aim(CONFIG, CAMERA)
    show(aim, VIEWS[0])
    (again,) = aim.instead_of(VIEWS[0])
    off = difference(seen_from(again, HAND, PLACE), seen_from(VIEWS[0], DRAWN_HAND, DRAWN_BOARD))
    planned = difference(seen_from(VIEWS[0], HAND, PLACE), seen_from(VIEWS[0], DRAWN_HAND, DRAWN_BOARD))
    # The board's own turn is still unknown: a few hundredths of what the view was off remain.
    assert np.linalg.norm(off[:3]) < 0.1 * np.linalg.norm(planned[:3])
    assert np.linalg.norm(planned[:3]) > 0.005


@pytest.mark.parametrize("missed", [10, 13, 19])
def test_any_view_is_right_once_hand_eye_and_board_are_known(missed):
    aim = Aim(CONFIG, CAMERA)
    for view in VIEWS[:8]:
        show(aim, view)
    (again,) = aim.instead_of(VIEWS[missed])
    off = difference(seen_from(again, HAND, PLACE), seen_from(VIEWS[missed], DRAWN_HAND, DRAWN_BOARD))
    planned = difference(seen_from(VIEWS[missed], HAND, PLACE), seen_from(VIEWS[missed], DRAWN_HAND, DRAWN_BOARD))
    assert np.linalg.norm(off[:3]) < 1e-4 < np.linalg.norm(planned[:3])


def test_without_any_view_the_surroundings_are_searched():
    tries = Aim(CONFIG, CAMERA).instead_of(VIEWS[0])
    wanted = seen_from(VIEWS[0], DRAWN_HAND, DRAWN_BOARD)
    shifts = np.array([seen_from(view, DRAWN_HAND, DRAWN_BOARD).translation - wanted.translation for view in tries])
    np.testing.assert_allclose(shifts[:, 2], 0.0, atol=1e-12)
    assert {tuple(np.round(shift[:2] / SEARCH_M).astype(int)) for shift in shifts} == {
        (x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y
    }

"""Which stripe points lie on a board, against the plane in closed form."""

import numpy as np
import pinocchio as pin
import pytest

from cell.measure.geometry.camera import CameraModel
from cell.measure.vision.board.view import parse_board
from cell.measure.vision.stripe.profile import StripeProfile
from cell.measure.vision.stripe_on_board import on_plane, points_on_board
from drivers.errors import RefusedError

CAMERA = CameraModel(640, 480, 1000.0, 1000.0, 320.0, 240.0)
BOARD = parse_board("dots:7x7:10mm")
POSE = pin.SE3(pin.exp3(np.array([0.0, 0.3, 0.0])), np.array([-0.03, -0.03, 0.25]))


def stripe(column: float, bent: float = 0.0) -> StripeProfile:
    """A straight line that leaves the board's plane beyond the picture's row 400 by `bent` px."""
    row = np.arange(480)
    centres = column + 0.02 * row + bent * (row > 400)
    one, no = np.ones(480), np.zeros(480, dtype=np.bool_)
    return StripeProfile("rows", centres, 0.05 * one, 100 * one, 1.5 * one, no, no)


def test_pixels_meet_the_plane_where_the_board_lies():
    places = np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.02, 0.05, 0.0]])
    points = np.array([POSE * place for place in places])
    np.testing.assert_allclose(on_plane(CAMERA, POSE, CAMERA.project(points)), points, atol=1e-9)
    away = pin.SE3(POSE.rotation, -POSE.translation)
    assert np.isnan(on_plane(CAMERA, away, CAMERA.project(points))).all()


def test_points_on_print_and_beyond_the_board_are_left_out():
    profile = stripe(322.0, bent=15.0)
    kept = points_on_board(CAMERA, POSE, BOARD, profile, 0.003)
    local = (on_plane(CAMERA, POSE, profile.pixels()) - POSE.translation) @ POSE.rotation
    nearest = np.linalg.norm(local[kept, None, :2] - BOARD.points()[None, :, :2], axis=2).min(axis=1)
    assert len(kept) > 100 and nearest.min() > 0.003
    assert kept.max() <= 400
    for nowhere in (stripe(20.0), stripe(np.nan)):
        assert not len(points_on_board(CAMERA, POSE, BOARD, nowhere, 0.003))


def test_a_board_that_leaves_no_room_for_a_stripe_is_refused_with_those_that_do():
    with pytest.raises(RefusedError, match=r"no stripe is read on .*; take a board of these: marked_dots"):
        points_on_board(CAMERA, POSE, parse_board("aprilgrid:6x6:5mm"), stripe(322.0), 0.0)

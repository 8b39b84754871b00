"""Promises of the board detection, on pictures rendered by the simulator's optics, which share no code with it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cell.measure.geometry.camera import seen_centres
from cell.measure.geometry.poses import difference, transform
from cell.measure.vision.board.board import board_pose, find_board
from cell.measure.vision.board.view import parse_board
from cell.measure.vision.pictures import PictureRefused, Reason
from tests.unit.cell.measure.vision.board.drawn_boards import (
    FINE,
    LARGE,
    SCAN,
    TARGET,
    model,
    photograph,
    placed,
    true_pixels,
)


@pytest.mark.parametrize(
    ("optics", "text", "distance", "tilt", "spin", "largest"),
    [
        (SCAN, FINE, 0.130, 0, 0.0, 0.03),
        (SCAN, FINE, 0.137, 25, 3.0, 0.03),
        (TARGET, LARGE, 1.0, 45, 0.3, 0.03),
        (TARGET, LARGE, 3.0, 20, 0.3, 0.05),
        (TARGET, "asymmetric_dots:4x11:15mm", 1.0, 30, 1.6, 0.03),
        (TARGET, "asymmetric_dots:4x11:15mm", 1.0, 60, 3.1, 0.04),
        (TARGET, "chessboard:7x6:20mm", 1.0, 40, 0.4, 0.08),
        (TARGET, "chessboard:7x6:20mm", 1.0, 30, 3.4, 0.08),
    ],
)
def test_every_point_is_found_under_its_own_name(optics, text, distance, tilt, spin, largest):
    pose = placed(text, distance, tilt, spin=spin)
    view = find_board(photograph(optics, text, pose), parse_board(text))
    assert len(view.ids) == len(view.spec.lattice())
    assert not view.order_assumed
    error = view.pixels - true_pixels(optics, pose, view)
    assert np.sqrt(np.mean(error**2)) < largest


@pytest.mark.parametrize(("blur", "share"), [(4.0, 1.0), (0.0, 0.15)])
def test_a_blurred_or_dark_board_is_found(blur, share):
    pose = placed(LARGE, 1.0, 30)
    picture = photograph(TARGET, LARGE, pose, exposure=12e-3).astype(np.float64) * share
    if blur:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    view = find_board(np.round(picture).astype(np.uint8), parse_board(LARGE))
    assert len(view.ids) == len(view.spec.lattice())
    assert np.sqrt(np.mean((view.pixels - true_pixels(TARGET, pose, view)) ** 2)) < 0.1


@pytest.mark.parametrize("distance", [0.8, 1.3])
def test_the_pose_is_right_and_its_covariance_honest(distance):
    pose = placed(LARGE, distance, 30)
    found = board_pose(find_board(photograph(TARGET, LARGE, pose), parse_board(LARGE)), model(TARGET))
    z = difference(found.camera_from_board, pose) / np.sqrt(np.diag(found.covariance))
    assert np.abs(z).max() < 4.5
    assert found.rms_px < 0.05
    assert np.degrees(found.obliquity) == pytest.approx(30, abs=0.1)


def test_two_poses_that_fit_alike_are_refused():
    pose = placed(LARGE, 6.0, 15)
    camera = model(TARGET)
    view = find_board(photograph(TARGET, LARGE, placed(LARGE, 1.0, 30)), parse_board(LARGE))
    pixels = camera.project(seen_centres(transform(pose, view.object_points), pose.rotation[:, 2], 5e-3))
    noisy = pixels + np.random.default_rng(1).normal(0, 0.5, pixels.shape)
    with pytest.raises(PictureRefused) as refused:
        board_pose(replace(view, pixels=noisy), camera)
    assert refused.value.reason is Reason.AMBIGUOUS


@pytest.mark.parametrize(
    ("spoilt", "reason"),
    [
        (lambda picture: picture // 30, Reason.BLACK),
        (lambda picture: np.full_like(picture, 255), Reason.SATURATED),
        (lambda picture: np.full_like(picture, 90), Reason.NO_BOARD),
        (lambda picture: np.ascontiguousarray(picture[:, ::-1]), Reason.MIRRORED),
    ],
    ids=["black", "saturated", "no board", "mirrored"],
)
def test_a_useless_picture_is_refused_with_its_reason(spoilt, reason):
    with pytest.raises(PictureRefused) as refused:
        find_board(spoilt(photograph(TARGET, LARGE, placed(LARGE, 1.0, 30))), parse_board(LARGE))
    assert refused.value.reason is reason
    assert len(str(refused.value)) > 20

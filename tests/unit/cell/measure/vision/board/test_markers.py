"""Promises on grids of AprilTags: corners to hundredths of a pixel, and a refusal that names the dictionary seen."""

from functools import cache

import cv2
import numpy as np
import pytest

from cell.measure.vision.board.board import find_board
from cell.measure.vision.board.view import parse_board
from cell.measure.vision.pictures import PictureRefused
from drivers.errors import ConfigError

TAG, GAP = 80, 24
TURN = np.array([[0.9, 0.1, 30], [-0.05, 0.8, 60], [1e-4, 2e-4, 1]])


@cache
def photograph(squares: bool) -> np.ndarray:
    """Six columns and five rows of tags, numbered from the last row up, warped by OpenCV at four times the size."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pitch = TAG + GAP
    sheet = np.full((5 * pitch + GAP + 120, 6 * pitch + GAP + 120), 255, np.uint8)
    for row, column in np.ndindex(5, 6):
        x, y = 60 + GAP + column * pitch, 60 + GAP + row * pitch
        sheet[y : y + TAG, x : x + TAG] = cv2.aruco.generateImageMarker(dictionary, (4 - row) * 6 + column, TAG)
    for row, column in np.ndindex(6, 7) if squares else ():
        sheet[60 + row * pitch : 60 + row * pitch + GAP, 60 + column * pitch : 60 + column * pitch + GAP] = 0
    large = np.diag([4.0, 4.0, 1.0])
    large[:2, 2] = 1.5
    fine = cv2.resize(sheet, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    into = large @ TURN @ np.linalg.inv(large)
    wide = cv2.warpPerspective(fine, into, (2560, 1920), flags=cv2.INTER_LINEAR, borderValue=128)
    small = cv2.resize(cv2.GaussianBlur(wide, (0, 0), 3.2), (640, 480), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(1).normal(0, 2, small.shape)
    return np.clip(small * 0.7 + 20 + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("squares", [True, False])
def test_corners_lie_where_they_were_drawn(squares):
    view = find_board(photograph(squares), parse_board("aprilgrid:6x5:26mm:20mm"))
    assert len(view.ids) == len(view.spec.lattice())
    drawn = view.object_points[:, :2] / 0.026 * (TAG + GAP) + 60 + GAP - 0.5
    off = view.pixels - cv2.perspectiveTransform(drawn[None], TURN)[0]
    assert np.abs(off.mean(axis=0)).max() < 0.01
    assert off.std() < 0.04
    assert 0.7 < np.sqrt(np.mean((off / view.sigma[:, None]) ** 2)) < 1.6


def test_tags_of_another_dictionary_are_named():
    with pytest.raises(PictureRefused, match="DICT_APRILTAG_36h11"):
        find_board(photograph(True), parse_board("aprilgrid:6x5:26mm:20mm:DICT_APRILTAG_25h9"))


def test_tags_of_one_row_are_said_to_lie_on_one_line():
    row = np.zeros((5 * (TAG + GAP) + GAP + 120, 6 * (TAG + GAP) + GAP + 120), np.uint8)
    row[60 + 2 * (TAG + GAP) : 60 + 3 * (TAG + GAP) + GAP] = 1
    one = np.where(cv2.warpPerspective(row, TURN, (640, 480)) > 0, photograph(False), 128).astype(np.uint8)
    with pytest.raises(PictureRefused, match="that were read lie on one line"):
        find_board(one, parse_board("aprilgrid:6x5:26mm:20mm"))


def test_a_single_tag_is_a_board_and_two_are_not():
    spec = parse_board("apriltag:36h11:50mm", single_tag=True)
    assert (spec.name, len(spec.points())) == ("apriltag:36h11:50mm", 4)
    image = photograph(False)
    corners = cv2.perspectiveTransform(np.array([[[280.0, 176], [384, 176], [384, 280], [280, 280]]]), TURN)[0]
    near = cv2.fillConvexPoly(np.zeros(image.shape, np.uint8), np.round(corners).astype(np.int32), 1)
    found = find_board(np.where(near > 0, image, 180).astype(np.uint8), spec)
    drawn = 60 + GAP + (TAG + GAP) * np.array([2, 1]) + TAG * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - 0.5
    assert np.abs(found.pixels - cv2.perspectiveTransform(drawn[None].astype(float), TURN)[0]).max() < 0.3
    with pytest.raises(PictureRefused, match=r"30 tags .* is one"):
        find_board(image, spec)
    with pytest.raises(ConfigError, match="unknown kind 'apriltag'"):
        parse_board("apriltag:36h11:50mm")


def test_markers_beyond_the_named_board_propose_the_right_counts():
    with pytest.raises(PictureRefused, match="By the markers read it has 6x5"):
        find_board(photograph(False), parse_board("aprilgrid:4x5:26mm:20mm"))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    sheet = cv2.aruco.CharucoBoard((9, 6), 0.03, 0.02, dictionary).generateImage((900, 620), marginSize=20)
    with pytest.raises(PictureRefused, match="By the markers read it has 9x6"):
        find_board(cv2.GaussianBlur(sheet, (0, 0), 1.0), parse_board("charuco:7x5:30mm:20mm"))


def test_charuco_corners_are_read_also_in_part():
    spec = parse_board("charuco:8x6:15mm")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    drawn = cv2.aruco.CharucoBoard((8, 6), 0.015, 0.0105, dictionary).generateImage((800, 600), marginSize=0)
    picture = np.full((768, 1024), 180, np.uint8)
    picture[100:700, 120:920] = drawn
    view = find_board(picture, spec)
    assert len(view.ids) == len(view.spec.lattice())
    # Pixel (0, 0) of the drawing is the middle of its corner pixel; squares are 100 px.
    expected = (spec.lattice() + 1) * 100.0 + (120, 100) - 0.5
    assert np.abs(view.pixels - expected[view.ids]).max() < 0.3
    part = find_board(np.where(np.arange(1024) < 560, picture, 180).astype(np.uint8), spec)
    assert 6 <= len(part.ids) < 35
    assert np.abs(part.pixels - expected[part.ids]).max() < 0.5

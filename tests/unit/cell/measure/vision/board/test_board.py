"""Promises of the board detection, on pictures rendered by the simulator's optics, which share no code with it."""

from __future__ import annotations

import cv2
import numpy as np
import pinocchio as pin
import pytest

from cell.measure.geometry.camera import CameraModel, seen_centres
from cell.measure.geometry.poses import difference, transform
from cell.measure.vision import PictureRefused, Reason, board_pose, find_board, parse_board, read_picture
from drivers.errors import ConfigError
from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.render import render
from sim_backends.optics.scene import Board, BoardInstance, LaserOptics

LENS = (-0.1, 0.15, 0.001, -0.0008, 0.0)
SCAN = CameraOptics(640, 480, 1670, 1665, 322, 236, LENS, focus_distance=0.13)
TARGET = CameraOptics(1280, 1024, 1668, 1664, 640, 508, LENS, focus_distance=1.0)
FINE, LARGE = "marked_dots:11x9:3mm", "marked_dots:9x7:20mm"


def model(optics: CameraOptics) -> CameraModel:
    return CameraModel(optics.width, optics.height, optics.fx, optics.fy, optics.cx, optics.cy, optics.distortion)


def placed(text: str, distance: float, tilt: float, azimuth: float = 0.5, spin: float = 0.3, shift=(0.0, 0.0)):
    """camera_from_board of a board whose centre is at `distance` m, tilted by `tilt` degrees."""
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * np.radians(tilt)
    rotation = pin.exp3(axis) @ pin.exp3(np.array([0.0, 0.0, spin]))
    return pin.SE3(rotation, np.array([*shift, distance]) - rotation @ np.array(parse_board(text).centre))


def photograph(optics, text, pose, laser=None, exposure=4e-3, seed=0):
    instance = BoardInstance(pose.homogeneous, Board.parse(text))
    return render(optics, [instance], laser, exposure, np.random.default_rng(seed))


def true_pixels(optics, pose, view):
    points = transform(pose, view.object_points)
    if view.dot_radius:
        points = seen_centres(points, pose.rotation[:, 2], 0.25 * view.spec.pitch)
    return optics.project(points)


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
    assert view.complete
    assert not view.order_assumed
    error = view.pixels - true_pixels(optics, pose, view)
    assert np.sqrt(np.mean(error**2)) < largest


def test_a_part_of_a_marked_board_is_enough():
    pose = placed(FINE, 0.130, 15, shift=(0.008, 0.006))
    view = find_board(photograph(SCAN, FINE, pose), parse_board(FINE))
    assert 60 < len(view.ids) < 99
    assert np.abs(view.pixels - true_pixels(SCAN, pose, view)).max() < 0.1


@pytest.mark.parametrize("text", [FINE, "chessboard:11x8:3mm"])
def test_a_laser_line_across_the_board_does_no_harm(text):
    pose = placed(text, 0.130, 10)
    view = find_board(photograph(SCAN, text, pose, LaserOptics(brightness=4e5)), parse_board(text))
    error = np.linalg.norm(view.pixels - true_pixels(SCAN, pose, view), axis=1)
    assert len(view.ids) > 0.7 * len(view.spec.lattice())
    assert np.median(error) < 0.08
    assert error.max() < 1.0


@pytest.mark.parametrize(("blur", "share"), [(4.0, 1.0), (0.0, 0.15)])
def test_a_blurred_or_dark_board_is_found(blur, share):
    pose = placed(LARGE, 1.0, 30)
    picture = photograph(TARGET, LARGE, pose, exposure=12e-3).astype(np.float64) * share
    if blur:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    view = find_board(np.round(picture).astype(np.uint8), parse_board(LARGE))
    assert view.complete
    assert np.sqrt(np.mean((view.pixels - true_pixels(TARGET, pose, view)) ** 2)) < 0.1


def test_symmetric_dots_say_that_their_order_is_assumed():
    text = "dots:6x6:34mm"
    pose = placed(text, 1.0, 40)
    view = find_board(photograph(TARGET, text, pose), parse_board(text))
    assert view.order_assumed
    true = [true_pixels(TARGET, pose, turn) for turn in view.turns()]
    assert len(true) == 4
    assert min(np.abs(view.pixels - t).max() for t in true) < 0.1


@pytest.mark.parametrize("distance", [0.8, 1.0, 1.3])
def test_the_pose_is_right_and_its_covariance_honest(distance):
    pose = placed(LARGE, distance, 30)
    found = board_pose(find_board(photograph(TARGET, LARGE, pose), parse_board(LARGE)), model(TARGET))
    z = difference(found.camera_from_board, pose) / np.sqrt(np.diag(found.covariance))
    assert np.abs(z).max() < 4.5
    assert found.rms_px < 0.05
    assert np.degrees(found.obliquity) == pytest.approx(30, abs=0.1)


@pytest.mark.parametrize("turn", [0.0, 0.35])
def test_dots_with_a_frame_round_them_end_there(turn):
    """Plates as some vision programs sell them: a black line where the next dots would be."""
    sheet = np.full((1000, 1000), 225, np.uint8)
    cv2.rectangle(sheet, (80, 80), (920, 920), 25, 14)
    for i, j in np.ndindex(7, 7):
        cv2.circle(sheet, (200 + 100 * i, 200 + 100 * j), 25, 25, -1, cv2.LINE_AA)
    into = np.array([[0.4 * np.cos(turn), -0.4 * np.sin(turn), 200], [0.4 * np.sin(turn), 0.36, 20], [0, 1e-4, 1.0]])
    image = cv2.warpPerspective(sheet, into, (640, 480), flags=cv2.INTER_AREA, borderValue=60)
    view = find_board(cv2.GaussianBlur(image, (0, 0), 0.8), parse_board("dots:7x7:25mm"))
    assert len(view.ids) == 49
    with pytest.raises(PictureRefused, match="7×7"):
        find_board(image, parse_board("dots:7x6:25mm"))


def test_two_poses_that_fit_alike_are_refused():
    pose = placed(LARGE, 6.0, 15)
    camera = model(TARGET)
    view = find_board(photograph(TARGET, LARGE, placed(LARGE, 1.0, 30)), parse_board(LARGE))
    pixels = camera.project(seen_centres(transform(pose, view.object_points), pose.rotation[:, 2], 5e-3))
    noisy = pixels + np.random.default_rng(1).normal(0, 0.5, pixels.shape)
    doubtful = type(view)(view.spec, view.size, view.ids, noisy, view.sigma, False, view.dot_radius)
    with pytest.raises(PictureRefused) as refused:
        board_pose(doubtful, camera)
    assert refused.value.reason is Reason.AMBIGUOUS


def spoilt(kind: str) -> np.ndarray:
    picture = photograph(TARGET, LARGE, placed(LARGE, 1.0, 30))
    return {
        "black": picture // 30,
        "saturated": np.full_like(picture, 255),
        "wrong_size": picture[:500],
        "no_board": np.full_like(picture, 90),
        "mirrored": np.ascontiguousarray(picture[:, ::-1]),
        "half": np.where(np.arange(1280) < 640, picture, 90).astype(np.uint8),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("black", Reason.BLACK),
        ("saturated", Reason.SATURATED),
        ("wrong_size", Reason.WRONG_SIZE),
        ("no_board", Reason.NO_BOARD),
        ("mirrored", Reason.MIRRORED),
    ],
)
def test_a_useless_picture_is_refused_with_its_reason(kind, reason):
    with pytest.raises(PictureRefused) as refused:
        find_board(spoilt(kind), parse_board(LARGE), (1280, 1024))
    assert refused.value.reason is reason
    assert len(str(refused.value)) > 20


def test_a_board_without_its_rings_is_refused():
    with pytest.raises(PictureRefused) as refused:
        find_board(spoilt("half"), parse_board(LARGE))
    assert refused.value.reason in (Reason.AMBIGUOUS, Reason.NO_BOARD)


def test_cut_and_foreign_files_are_refused(tmp_path):
    whole = tmp_path / "whole.png"
    cv2.imwrite(str(whole), spoilt("half"))
    assert read_picture(whole).shape == (1024, 1280)
    cut = tmp_path / "cut.png"
    cut.write_bytes(whole.read_bytes()[:-2000])
    text = tmp_path / "text.jpg"
    text.write_text("no picture")
    for path, reason in ((cut, Reason.CUT), (text, Reason.UNREADABLE), (tmp_path / "none.png", Reason.UNREADABLE)):
        with pytest.raises(PictureRefused) as refused:
            read_picture(path)
        assert refused.value.reason is reason


def test_charuco_corners_are_read_also_in_part():
    text = "charuco:8x6:15mm"
    spec = parse_board(text)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    drawn = cv2.aruco.CharucoBoard((8, 6), 0.015, 0.0105, dictionary).generateImage((800, 600), marginSize=0)
    picture = np.full((768, 1024), 180, np.uint8)
    picture[100:700, 120:920] = drawn
    view = find_board(picture, spec)
    assert view.complete
    # Pixel (0, 0) of the drawing is the middle of its corner pixel; squares are 100 px.
    expected = (spec.lattice() + 1) * 100.0 + (120, 100) - 0.5
    assert np.abs(view.pixels - expected[view.ids]).max() < 0.3
    part = find_board(np.where(np.arange(1024) < 560, picture, 180).astype(np.uint8), spec)
    assert 6 <= len(part.ids) < 35
    assert np.abs(part.pixels - expected[part.ids]).max() < 0.5


@pytest.mark.parametrize("name", [FINE, "chessboard:7x6:10mm", "dots:6x6:34mm", "asymmetric_dots:4x11:15mm"])
def test_board_names_round_trip(name):
    assert parse_board(name).name == name


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("chessboard", "parts"),
        ("chess:7x6:10mm", "unknown kind"),
        ("chessboard:7by6:10mm", "columns x rows"),
        ("chessboard:7x6:10", "unit"),
        ("chessboard:1x6:10mm", "needs"),
        ("chessboard:7x6:0mm", "outside"),
        ("chessboard:7x6:10mm:3mm", "nothing may follow"),
        ("charuco:8x6:15mm:DICT_9X9", "dictionary"),
        ("charuco:8x6:15mm:20mm", "smaller"),
    ],
)
def test_a_wrong_board_name_says_what_is_wrong(name, complaint):
    with pytest.raises(ConfigError, match=complaint):
        parse_board(name)

"""Promises of the simulated pictures of boards: where the dots are, how bright they are, what may be out of view.

The truth is OpenCV's projection of each dot's outline and the area centroid of that outline.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_backends.optics import Board, BoardInstance, CameraOptics, Light, PlaneInstance, expected_image, render, sensor

FOCAL_PX = 8e-3 / 4.8e-6
LENS = (-0.08, 0.03, 4e-4, -3e-4, 0.01)
SCAN = CameraOptics(640, 480, FOCAL_PX, FOCAL_PX, 319.5, 239.5, LENS, transmission=0.4, vignetting=0.0)
TARGET = CameraOptics(1280, 1024, FOCAL_PX, FOCAL_PX, 639.5, 511.5, LENS, focus_distance=1.0, vignetting=0.0)
EVEN = Light(gradient=(0.0, 0.0), diffuse=1.0, surroundings=0.35)
FINE = Board.parse("marked_dots:11x9:3mm")
LARGE = Board.parse("marked_dots:9x7:20mm")


def pose(rotation_vector, translation):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def expose(optics, scene, exposure, laser=None, light=EVEN):
    return expected_image(optics, scene, laser, exposure, np.random.default_rng(0), light).astype(float)


def outline(optics, camera_from_board, centre, radius):
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    circle = centre + radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    points = circle @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
    matrix = np.array([[optics.fx, 0, optics.cx], [0, optics.fy, optics.cy], [0, 0, 1.0]])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(optics.distortion))
    return pixels[:, 0]


def area_and_centroid(polygon):
    x, y = polygon.T
    xn, yn = np.roll(x, -1), np.roll(y, -1)
    cross = x * yn - xn * y
    area = cross.sum() / 2
    return abs(area), np.array([((x + xn) * cross).sum(), ((y + yn) * cross).sum()]) / (6 * area)


def measured_dot(image, white, black, polygon, margin):
    low = np.floor(polygon.min(axis=0) - margin).astype(int)
    high = np.ceil(polygon.max(axis=0) + margin).astype(int) + 1
    part = (white - image[low[1] : high[1], low[0] : high[0]]) / (white - black)
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]]
    return part.sum(), np.array([(part * u).sum(), (part * v).sum()]) / part.sum()


@pytest.mark.parametrize(
    ("optics", "board", "camera_from_board", "exposure"),
    [
        (SCAN, FINE, pose([0.2, 0.06, 0.02], [-0.015, -0.012, 0.130]), 0.020),
        (SCAN, FINE, pose([-0.2, 0.2, 0.3], [-0.009, -0.015, 0.142]), 0.020),
        (TARGET, LARGE, pose([0.1, 0.6, 0.1], [-0.12, -0.05, 1.0]), 0.008),
        (SCAN, Board.parse("asymmetric_dots:4x11:3mm"), pose([-0.2, 0.1, 0.1], [-0.012, -0.015, 0.130]), 0.020),
        (SCAN, Board.parse("dots:6x6:4mm"), pose([0.1, -0.3, 0.0], [-0.010, -0.010, 0.125]), 0.020),
    ],
)
def test_dots_are_where_the_lens_puts_them(optics, board, camera_from_board, exposure):
    image = expose(optics, [BoardInstance(camera_from_board, board)], exposure)
    light = 25_000 * optics.transmission * exposure
    white, black = board.white * light, board.black * light
    blur = float(optics.blur_px(camera_from_board[2, 3]))
    errors = []
    for centre in board.points:
        polygon = outline(optics, camera_from_board, centre, board.dot_radius)
        area, truth = area_and_centroid(polygon)
        seen_area, seen = measured_dot(image, white, black, polygon, 4 * blur + 1)
        if seen_area > 0.95 * area:  # the rings' white centres are another test's matter
            assert seen_area == pytest.approx(area, rel=2e-3)
            errors.append(seen - truth)
    assert len(errors) >= len(board.points) - 3
    assert np.abs(errors).max() <= 0.002


def test_three_dots_are_rings_and_lie_where_the_pattern_says():
    camera_from_board = pose([0.0, 0.0, 0.0], [-0.015, -0.012, 0.130])
    image = expose(SCAN, [BoardInstance(camera_from_board, FINE)], 0.020)
    pixels = SCAN.project(FINE.points + camera_from_board[:3, 3])
    centres = np.array([image[round(v), round(u)] for u, v in pixels]).reshape(9, 11)
    bright = {(int(c), int(r)) for r, c in np.argwhere(centres > 100)}
    assert bright == {(5, 4), (7, 4), (5, 5)}


def test_chessboard_squares_agree_with_brute_force_sampling():
    board = Board.parse("chessboard:7x6:4mm")
    sharp = replace(SCAN, psf_px=0.0, focus_distance=0.135)
    camera_from_board = pose([0.25, -0.1, 0.05], [-0.012, -0.009, 0.130])
    image = expose(sharp, [BoardInstance(camera_from_board, board)], 0.020) / (25_000 * 0.4 * 0.020)
    u0, v0, n = 195, 105, 16
    fine = (np.arange(60 * n) + 0.5) / n - 0.5
    u, v = np.meshgrid(u0 + fine, v0 + fine)
    matrix = np.array([[SCAN.fx, 0, SCAN.cx], [0, SCAN.fy, SCAN.cy], [0, 0, 1.0]])
    pixels = np.column_stack([u.ravel(), v.ravel()])[:, None]
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-12)
    rays = cv2.undistortPointsIter(pixels, matrix, np.array(SCAN.distortion), np.eye(3), np.eye(3), criteria)[:, 0]
    normal, origin = camera_from_board[:3, 2], camera_from_board[:3, 3]
    rays = np.column_stack([rays, np.ones(len(rays))])
    points = rays * (normal @ origin / (rays @ normal))[:, None]
    local = (points - origin) @ camera_from_board[:3, :3]
    dark = (np.floor(local[:, 0] / 0.004) + np.floor(local[:, 1] / 0.004)) % 2 == 0
    truth = np.where(dark, board.black, board.white).reshape(60, n, 60, n).mean(axis=(1, 3))
    assert truth.min() < 0.1
    assert np.abs(image[v0 : v0 + 60, u0 : u0 + 60] - truth).max() < 0.04
    assert np.abs(image[v0 : v0 + 60, u0 : u0 + 60] - truth).mean() < 0.0005


def test_boards_are_exposed_as_the_cameras_expect():
    near = BoardInstance(pose([0, 0, 0], [-0.015, -0.012, 0.130]), FINE)
    far = BoardInstance(pose([0, 0, 0], [-0.08, -0.06, 1.0]), LARGE)
    assert 170 <= expose(SCAN, [near], 0.020).max() <= 200
    assert 170 <= expose(TARGET, [far], 0.008).max() <= 200
    table = PlaneInstance(pose([0, 0, 0], [0, 0, 0.130]), (1.0, 1.0), 0.5)
    assert 8 <= np.median(expose(SCAN, [table], 0.002)) <= 15


def test_light_doubles_with_exposure_and_with_the_lamp():
    scene = [BoardInstance(pose([0.1, 0, 0], [-0.015, -0.012, 0.130]), FINE)]
    once = expose(SCAN, scene, 0.004)
    np.testing.assert_allclose(expose(SCAN, scene, 0.008), 2 * once, rtol=1e-5)
    bright = Light(level=2.0, gradient=(0.0, 0.0), diffuse=1.0)
    np.testing.assert_allclose(expose(SCAN, scene, 0.004, light=bright), 2 * once, rtol=1e-5)


def test_a_board_out_of_focus_is_blurred_by_the_thin_lens_formula():
    # The scan camera, focused at 130 mm, blurs a point at 1 m over a disc of 24 px (docs/explanation/theory.md, section
    # 4).
    disc = 8e-3 / 4 * 8e-3 * 0.87 / (1.0 * 0.122) / 4.8e-6
    assert disc == pytest.approx(23.8, abs=0.1)
    assert float(SCAN.blur_px(1.0)) == pytest.approx(np.hypot(0.6, disc / 4))
    edge = PlaneInstance(pose([0, 0, 0], [0.1, 0.0, 1.0]), (0.2, 2.0), 0.9)
    profile = expose(SCAN, [edge], 0.020)[240]
    slope = np.diff(profile)
    column = np.arange(len(slope)) + 0.5
    centre = (slope * column).sum() / slope.sum()
    spread = np.sqrt((slope * (column - centre) ** 2).sum() / slope.sum())
    assert spread == pytest.approx(np.hypot(0.6, disc / 4), rel=0.03)


@pytest.mark.parametrize(
    "translation",
    [[-0.015, -0.012, -0.130], [2.0, 0.0, 0.130], [0.0, 0.0, 0.0]],
    ids=["behind", "beside", "edge on in the lens"],
)
def test_boards_that_cannot_be_seen_are_left_out(translation):
    image = expose(SCAN, [BoardInstance(pose([0, 0, 0], translation), FINE)], 0.020)
    np.testing.assert_allclose(image, 0.35 * 25_000 * 0.4 * 0.020, rtol=1e-5)


def test_a_board_partly_out_of_view_shows_the_part_that_is_in_view():
    wide = CameraOptics(1280, 480, FOCAL_PX, FOCAL_PX, 639.5, 239.5, LENS, transmission=0.4, vignetting=0.0)
    shifted = pose([0.3, 0.1, 0.1], [0.005, -0.012, 0.130])
    narrow_view = expose(SCAN, [BoardInstance(shifted, FINE)], 0.020)
    wide_view = expose(wide, [BoardInstance(shifted, FINE)], 0.020)
    np.testing.assert_allclose(narrow_view[:, :-10], wide_view[:, 320:950], atol=0.02)
    assert 0.05 < (narrow_view > 100).mean() < 0.5


def test_the_back_of_a_board_has_no_dots():
    image = expose(SCAN, [BoardInstance(pose([np.pi, 0, 0], [-0.015, 0.012, 0.130]), FINE)], 0.020)
    assert image.min() > 0.3 * 25_000 * 0.4 * 0.020


@pytest.mark.parametrize("level", [2.25, 60.0, 200.0])
def test_sensor_noise_has_the_stated_mean_and_variance(level):
    picture = sensor(np.full((480, 640), level, np.float32), SCAN, np.random.default_rng(3)).astype(float)
    assert picture.mean() == pytest.approx(level, abs=0.01)
    assert picture.var() == pytest.approx(level / 40 + 0.4**2 + 1 / 12, rel=0.02)


def test_sensor_saturates_at_255_and_never_wraps():
    image = np.full((64, 64), 400, np.float32)
    image[:32] = 0
    picture = sensor(image, SCAN, np.random.default_rng(0))
    assert (picture[32:] == 255).all()
    assert picture[:32].max() <= 3


def test_the_same_seed_gives_the_same_picture_and_another_seed_another():
    scene = [BoardInstance(pose([0.1, 0, 0], [-0.015, -0.012, 0.130]), FINE)]
    first, again, other = (render(SCAN, scene, None, 0.020, np.random.default_rng(s)) for s in (5, 5, 6))
    assert first.dtype == np.uint8
    assert first.shape == (480, 640)
    assert (first == again).all()
    assert (first != other).mean() > 0.3


def test_undistortion_undoes_the_lens_to_a_nanopixel():
    pixels = np.array([[0.0, 0.0], [639.0, 479.0], [319.5, 239.5], [17.3, 440.2]])
    rays = np.column_stack([SCAN.undistort(pixels), np.ones(4)])
    matrix = np.array([[SCAN.fx, 0, SCAN.cx], [0, SCAN.fy, SCAN.cy], [0, 0, 1.0]])
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(SCAN.distortion))
    np.testing.assert_allclose(back[:, 0], pixels, atol=1e-9)

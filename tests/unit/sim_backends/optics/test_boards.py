"""Promises of the simulated pictures of boards: where the dots are.

The truth is OpenCV's projection of each dot's outline and the area centroid of that outline.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sim_backends.optics import Board, BoardInstance
from tests.support.simulator.optics_scene import FINE, LARGE, SCAN, TARGET, expose, pose


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


def test_the_back_of_a_board_has_no_dots():
    image = expose(SCAN, [BoardInstance(pose([np.pi, 0, 0], [-0.015, 0.012, 0.130]), FINE)], 0.020)
    assert image.min() > 0.3 * 25_000 * 0.4 * 0.020

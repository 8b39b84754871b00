"""Pictures of boards from the simulator's optics, which share no code with the detection."""

import numpy as np
import pinocchio as pin

from cell.measure.geometry.camera import CameraModel, seen_centres
from cell.measure.geometry.poses import transform
from cell.measure.vision.board.view import centre_of, parse_board
from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.render import render
from sim_backends.optics.scene import Board, BoardInstance

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
    return pin.SE3(rotation, np.array([*shift, distance]) - rotation @ centre_of(parse_board(text)))


def photograph(optics, text, pose, laser=None, exposure=4e-3, seed=0):
    instance = BoardInstance(pose.homogeneous, Board.parse(text))
    return render(optics, [instance], laser, exposure, np.random.default_rng(seed))


def true_pixels(optics, pose, view):
    points = transform(pose, view.object_points)
    if view.dot_radius:
        points = seen_centres(points, pose.rotation[:, 2], 0.25 * view.spec.pitch)
    return optics.project(points)


BRIGHT, DARK, PSF = 170.0, 14.0, 0.7
# A fifth of what levels taken beside the edges and light that is only added would do.
MOST_MOVED_PX = 0.004
SLOPES = [(0.003, 0.0), (-0.002, 0.002)]


def uneven_picture(pattern, slope, middle=(64.0, 64.0)):
    """An 8-bit picture (129, 129): light that changes by `slope` (2,) of itself per px, times a pattern."""
    v, u = np.mgrid[0:129, 0:129].astype(np.float64)
    light = 1 + slope[0] * (u - middle[0]) + slope[1] * (v - middle[1])
    return np.clip(np.round(light * pattern(u, v)), 0, 255).astype(np.uint8)

"""A board is seen where the camera projects it, and the equations of its pose are those of finite differences."""

import numpy as np
import pinocchio as pin

from cell.measure.geometry.board_projection import pose_equations, seen_points
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.poses import from_parts, perturbed, transform

CAMERA = CameraModel(640, 480, 1666.0, 1670.0, 322.0, 236.0, (-0.12, 0.21, 1.1e-3, -0.7e-3, -0.05))


def numerical(f, x, step=1e-6):
    """Central differences of a vector function at x: (outputs, inputs)."""
    columns = []
    for k in range(len(x)):
        d = np.zeros(len(x))
        d[k] = step
        columns.append((f(x + d) - f(x - d)) / (2 * step))
    return np.column_stack(columns)


def test_a_boards_points_are_seen_where_the_camera_projects_them():
    pose = from_parts((0.01, -0.02, 0.3), pin.exp3(np.array([0.4, -0.3, 1.0])))
    points = np.column_stack([np.random.default_rng(4).uniform(-0.05, 0.05, (30, 2)), np.zeros(30)])
    pixels = np.empty((30, 2))

    def seen(at: pin.SE3) -> np.ndarray:
        seen_points(CAMERA.parameters, at.rotation, at.translation, points, 0.0, pixels)
        return pixels.copy()

    np.testing.assert_allclose(seen(pose), CAMERA.project(transform(pose, points)), atol=1e-9)
    behind = from_parts(-pose.translation, pose.rotation)
    assert np.isnan(seen(behind)).all()
    # The equations that bring a pose to the pixels: those of the derivatives by finite differences.
    residual, factor = np.random.default_rng(5).normal(0, 1, (30, 2)), np.linspace(1, 3, 30)
    normal, right = np.empty((6, 6)), np.empty(6)
    pose_equations(CAMERA.parameters, pose.rotation, pose.translation, points, factor, residual, normal, right)
    slopes = numerical(lambda d: seen(perturbed(pose, d)).ravel(), np.zeros(6)) * np.repeat(factor, 2)[:, None]
    np.testing.assert_allclose(normal, slopes.T @ slopes, rtol=1e-5, atol=1e-5 * normal.max())
    np.testing.assert_allclose(right, slopes.T @ (factor[:, None] * residual).ravel(), rtol=1e-4, atol=1e-2)

"""Promises of the geometry: derivatives are those of finite differences, closed forms are cases of the general one."""

import cv2
import numpy as np

from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane, triangulate
from tests.unit.cell.measure.geometry.test_board_projection import CAMERA, numerical

THETA = np.arctan(3.5)


def points_in_front(n: int = 50) -> np.ndarray:
    rng = np.random.default_rng(4)
    return np.column_stack([rng.uniform(-0.02, 0.02, n), rng.uniform(-0.015, 0.015, n), rng.uniform(0.11, 0.15, n)])


def test_projection_is_opencvs_and_rays_undo_it():
    points = points_in_front()
    seen = CAMERA.project(points)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(CAMERA.dist))
    np.testing.assert_allclose(seen, theirs[:, 0], atol=1e-9)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(CAMERA.rays(seen), rays, atol=1e-12)


def test_a_point_behind_the_camera_has_no_pixel():
    assert np.isnan(CAMERA.project([[0.0, 0.0, -1.0]])).all()


def test_parameter_jacobian_is_that_of_finite_differences():
    points = points_in_front(5)
    scale = np.maximum(np.abs(CAMERA.parameters), 1.0)
    for p, jacobian in zip(points, CAMERA.parameter_jacobian(points), strict=True):

        def by_scaled(q, p=p):
            return CAMERA.with_parameters(q * scale).project(p)[0]

        expected = numerical(by_scaled, CAMERA.parameters / scale)
        np.testing.assert_allclose(jacobian * scale, expected, rtol=1e-5, atol=1e-5)


def test_triangulation_jacobians_are_those_of_finite_differences():
    plane = LightPlane.of((0.95, 0.03, -0.29), -0.034)
    ray = CAMERA.rays([[300.0, 100.0]])[0]
    _, by_ray, by_normal, by_distance = plane.intersect_with_jacobians(ray)

    def meet(u, n=plane.n, d=plane.distance):
        return d * u / (n @ u)

    np.testing.assert_allclose(by_ray[0], numerical(meet, ray), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(by_normal[0], numerical(lambda n: meet(ray, n=n), plane.n), rtol=1e-6, atol=1e-8)
    expected = numerical(lambda d: meet(ray, d=d[0]), np.array([plane.distance]))
    np.testing.assert_allclose(by_distance[0], expected[:, 0], rtol=1e-6)


def test_pixel_to_point_jacobian_is_that_of_finite_differences():
    plane = LightPlane.from_baseline(0.035, THETA)
    pixel = np.array([350.0, 200.0])
    _, jacobian = triangulate(CAMERA, plane, pixel)
    expected = numerical(lambda q: triangulate(CAMERA, plane, q)[0][0], pixel, 1e-3)
    np.testing.assert_allclose(jacobian[0], expected, rtol=1e-6, atol=1e-10)


def test_the_papers_closed_form_is_a_case_of_the_general_one():
    """Its equation (1), corrected, of image coordinates x', y' in m on the sensor."""
    f, baseline, pixel = 8e-3, 0.035, 4.8e-6
    camera = CameraModel(640, 480, f / pixel, f / pixel, 319.5, 239.5)
    pixels = np.column_stack([np.linspace(0, 639, 40), np.linspace(10, 470, 40)])
    x, y = pixel * (pixels - (319.5, 239.5)).T
    closed_form = baseline * np.stack([x, y, np.full(40, f)], axis=1) / (f / np.tan(THETA) - x)[:, None]
    general = LightPlane.from_baseline(baseline, THETA).intersect(camera.rays(pixels))
    np.testing.assert_allclose(closed_form, general, rtol=1e-12)


def test_rays_at_the_vanishing_line_are_rejected():
    f = 8e-3
    vanishing = f / np.tan(THETA)
    rays = np.array([[vanishing, 0.0, f], [vanishing * 1.2, 0.0, f]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert np.isnan(LightPlane.from_baseline(0.035, THETA).intersect(rays)).all()


def test_a_plane_that_was_kept_comes_back_to_the_last_bit():
    for normal in np.random.default_rng(3).normal(size=(300, 3)):
        plane = LightPlane.of(normal, 0.0333)
        assert LightPlane.of(list(plane.normal), plane.distance) == plane


def test_plane_fit_finds_the_plane_of_its_points():
    truth = LightPlane.of((0.3, -0.2, 0.9), 0.4)
    rays = CAMERA.rays(np.random.default_rng(1).uniform(0, 480, (30, 2)))
    fitted = LightPlane.fit(truth.intersect(rays))
    np.testing.assert_allclose([*fitted.normal, fitted.distance], [*truth.normal, truth.distance], atol=1e-9)

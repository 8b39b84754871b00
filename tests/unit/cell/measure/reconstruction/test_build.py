"""The cloud lies where an independent ray trace puts the surface, and its noise is what it says."""

import cv2
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.reconstruction.build import ProfileBuilder, ScanGeometry, calibration_motions
from cell.measure.reconstruction.cloud import Cloud
from cell.measure.vision.stripe.profile import StripeProfile
from drivers.errors import RefusedError
from lab.bench.reconstruction.scenes import swept

Array = NDArray[np.float64]

DIST = (-0.08, 0.05, 4e-4, -3e-4, 0.0)
MATRIX = np.array([[1668.0, 0.0, 322.0], [0.0, 1664.0, 237.0], [0.0, 0.0, 1.0]])
CAMERA = CameraModel(640, 480, 1668.0, 1664.0, 322.0, 237.0, DIST)
PLANE = LightPlane.of((1.0, 0.01, -1 / 3.5), -0.0351)
RAIL = np.array([1.0008, 0.004, -0.003])
MOUNT = pin.SE3(pin.utils.rotate("z", 1.57) @ pin.utils.rotate("x", 0.01), np.array([0.09, -0.05, 0.08]))
GEOMETRY = ScanGeometry(CAMERA, PLANE, RAIL, MOUNT)
DOWN = np.column_stack([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
BASE_FROM_FLANGE = pin.SE3(DOWN @ pin.utils.rotate("x", 0.02), np.array([0.70, -0.09, 0.26]))
TABLE = 0.05
"""Height of the scanned plane in the base, m."""


def profile(centres: Array, sigma: float = 0.07) -> StripeProfile:
    one, none = np.ones(len(centres)), np.zeros(len(centres), dtype=bool)
    return StripeProfile("rows", centres, sigma * one, 150 * one, 2 * one, none, none)


def table_stripe(rail: float) -> Array:
    """Columns (480,) at which OpenCV's projection sees the laser line on the table, from the base, point by point."""
    base_from_camera = BASE_FROM_FLANGE * MOUNT
    normal, offset = PLANE.n, PLANE.distance
    origin = base_from_camera.translation + base_from_camera.rotation @ (rail * RAIL)
    n = base_from_camera.rotation @ normal
    # Table z = TABLE and light plane n·(p − origin) = offset meet in a line; sample it finely.
    way = np.cross(n, [0.0, 0.0, 1.0])
    a = np.array([n, [0, 0, 1], way])
    foot = np.linalg.solve(a, [offset + n @ origin, TABLE, way @ origin])
    line = foot + np.linspace(-0.03, 0.03, 4001)[:, None] * way / np.linalg.norm(way)
    seen = (line - origin) @ base_from_camera.rotation
    pixels = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), MATRIX, np.array(DIST))[0].reshape(-1, 2)
    order = np.argsort(pixels[:, 1])
    return np.interp(np.arange(480), pixels[order, 1], pixels[order, 0])


def built(noise: float = 0.0, lines: int = 60) -> Cloud:
    rng = np.random.default_rng(0)
    profiles = (
        (profile(table_stripe(rail) + noise * rng.standard_normal(480), max(noise, 0.01)), rail)
        for rail in np.linspace(0.02, 0.08, lines)
    )
    return swept(GEOMETRY, profiles, 1e-6, BASE_FROM_FLANGE)


def test_the_table_is_where_an_independent_projection_puts_it():
    cloud = built()
    assert cloud.shape == (60, 480)
    assert np.abs(cloud.points[:, :, 2] - TABLE).max() < 1e-7
    assert not cloud.rejected.any()


def test_the_noise_of_the_points_is_what_the_cloud_says():
    cloud = built(noise=0.08)
    lines, rows = np.nonzero(cloud.valid)
    up = np.tile([0.0, 0.0, 1.0], (len(lines), 1))
    sigma = cloud.sigma_along(lines, rows, up)
    ratio = (cloud.points[lines, rows, 2] - TABLE) / sigma
    assert np.std(ratio) == pytest.approx(1.0, abs=0.02)
    assert np.abs(np.mean(ratio)) < 0.03
    assert 1e-5 < np.median(sigma) < 5e-5
    full = np.sqrt(cloud.covariances(lines, rows)[:, 2, 2])
    assert np.allclose(full, sigma)


def test_an_error_of_the_rail_moves_a_whole_line_as_its_spread_says():
    seen = [(profile(table_stripe(rail)), rail) for rail in np.linspace(0.04, 0.05, 10)]
    told = ([(one, rail + error) for one, rail in seen] for error in (0.0, 2e-5))
    clouds = [swept(GEOMETRY, profiles, 2e-5, BASE_FROM_FLANGE) for profiles in told]
    moved = clouds[1].points - clouds[0].points
    assert np.abs(moved - clouds[0].rail_spread[:, None]).max() < 1e-12
    assert np.linalg.norm(clouds[0].rail_spread, axis=1) == pytest.approx(2e-5 * np.linalg.norm(RAIL))


def test_another_calibration_moves_the_points_as_foretold():
    cloud = built()
    other = ScanGeometry(CAMERA, LightPlane.of((1.0, 0.01, -1 / 3.501), -0.03512), RAIL * 1.0002, MOUNT)
    lines, rows = cloud.subsample(500)
    foretold = calibration_motions(cloud, lines, rows, BASE_FROM_FLANGE, GEOMETRY, [other])[:, :, 0]
    moved = swept(other, ((profile(table_stripe(rail)), rail) for rail in cloud.rail), 1e-6, BASE_FROM_FLANGE)
    seen = moved.points[lines, rows] - cloud.points[lines, rows]
    assert np.abs(foretold - seen).max() < 1e-9 and np.abs(foretold).max() > 1e-5


def test_rows_without_a_stripe_are_holes_and_lines_are_sorted():
    rails = (0.042, 0.040, 0.044, 0.041, 0.043)
    centres = [table_stripe(rail) for rail in rails]
    for columns in centres:
        columns[100:200] = np.nan
    cloud = swept(GEOMETRY, zip(map(profile, centres), rails, strict=True), 1e-5, BASE_FROM_FLANGE)
    assert np.all(np.diff(cloud.rail) > 0) and np.all(np.isnan(cloud.points[:, 100:200]))
    assert cloud.size == 5 * 380


def test_a_profile_of_another_camera_and_a_sweep_without_points_are_refused():
    with pytest.raises(ValueError, match="camera of 480 rows"):
        ProfileBuilder(GEOMETRY).see(profile(np.full(1024, 300.0)))
    with pytest.raises(RefusedError, match="gave 0 points in 1 profiles"):
        swept(GEOMETRY, [(profile(np.full(480, np.nan)), 0.0)], 1e-5, BASE_FROM_FLANGE)


def test_a_subsample_is_spread_over_all_lines_and_rows():
    cloud = built()
    lines, rows = cloud.subsample(2000)
    assert len(lines) <= 2000
    assert np.bincount(lines, minlength=60).min() > 20
    assert np.histogram(rows, bins=10, range=(0, 480))[0].min() > 150

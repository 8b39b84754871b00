"""A bowed light sheet: found beside the rest of the calibration where it is, and not where it is not.

The observations come from a generator that shares nothing with the estimator; it tells the bow by the distance from the
laser, the product by that along the camera's axis."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import load_config
from cell.measure.calibration.solve.adjustment import Adjustment
from cell.measure.calibration.solve.bow import one_more
from cell.measure.calibration.solve.joint import Joint, solve_joint, solve_staged
from cell.measure.calibration.solve.normal import PLANE
from cell.measure.calibration.solve.results import ScanCalibration
from cell.measure.geometry.light_plane import LightPlane
from lab.bench.calibration.campaign import observe
from lab.bench.calibration.world import HeadWorld, Noise, draw_head

NOISE = Noise()
BESIDE, DEPTH = 0.018, 0.130


@cache
def solved(off: float, seed: int) -> tuple[HeadWorld, Joint]:
    """A head whose sheet is `off` m away from its plane at the place where bows are told, and its calibration."""
    rng = np.random.default_rng(seed)
    world = replace(draw_head(rng), bow=off * DEPTH / BESIDE**2)
    observations = observe(world, NOISE, rng)
    staged = solve_staged(observations, nominal_camera(load_config(None).scan_camera))
    return world, solve_joint(observations, staged, NOISE.priors, held_out=False)


@pytest.mark.parametrize(("off", "seed"), [(50e-6, 1), (-20e-6, 2)])
def test_a_bow_is_known_to_three_micrometres_and_as_stated(off: float, seed: int):
    _, joint = solved(off, seed)
    bow, plane = joint.adjusted.bow, joint.adjusted.state.plane
    found, sigma = (abs(value) * BESIDE**2 / DEPTH for value in (bow.value, bow.sigma))
    # Along the axis instead of along the fan: the distance is shorter by the cosine.
    found *= np.hypot(plane.normal[0], plane.normal[1]) ** -1
    assert found == pytest.approx(abs(off), abs=3e-6)
    assert abs(found - abs(off)) < 4 * sigma
    assert sigma < 1e-6
    # Not hidden in the noise: the stripe's is found as it was drawn.
    assert joint.adjusted.priors.stripe_scale == pytest.approx(1.0, abs=0.1)


def test_a_flat_sheet_stays_flat():
    _, joint = solved(0.0, 3)
    assert joint.adjusted.bow is None


def test_points_are_measured_on_the_bowed_sheet():
    world, joint = solved(50e-6, 1)
    calibration = ScanCalibration.of(joint)
    assert "bowed" in calibration.notes[0]
    rows = np.arange(20.0, 460.0, 20.0)
    off = []
    for view in range(0, len(world.rails), 4):
        columns, _ = world.stripe(view, np.zeros(7), rows)
        pixels, rails = np.column_stack([columns, rows]), np.full(len(rows), world.rails[view])
        points, _ = calibration.geometry().solve(pixels, rails)
        board = np.linalg.solve(world.flanges[view], world.board)
        off.append((points - board[:3, 3]) @ board[:3, 2])
    # Without the bow they lie on an arc 0.17 mm high; what is left is what the whole calibration is off.
    assert max(np.ptp(one) for one in off) < 0.06e-3


def test_the_bow_is_kept_with_the_calibration_and_varied_by_its_deviation():
    _, joint = solved(50e-6, 1)
    calibration = ScanCalibration.of(joint)
    again = ScanCalibration.from_dict(calibration.as_dict())
    # The normal is brought to length 1 again, which may change its last digit.
    assert again.light_plane.normal == pytest.approx(calibration.light_plane.normal, rel=1e-15, abs=1e-15)
    assert again.light_plane.distance == pytest.approx(calibration.light_plane.distance, rel=1e-15)
    assert (again.light_plane.bow, again.bow_sigma) == (calibration.light_plane.bow, calibration.bow_sigma)
    bows = [variant.light_plane.bow for variant in again.variants()]
    assert bows[-1] - calibration.light_plane.bow == pytest.approx(calibration.bow_sigma)
    assert set(bows[:-1]) == {calibration.light_plane.bow}


def test_rays_meet_the_bowed_sheet_and_its_derivatives_are_right():
    sheet = LightPlane.of((1.0, 0.03, -1 / 3.5), -0.035).bowed(0.02)
    rng = np.random.default_rng(7)
    rays = np.column_stack([rng.uniform(-0.1, 0.1, 40), rng.uniform(-0.15, 0.15, 40), np.ones(40)])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    points, by_ray, _, by_distance = sheet.intersect_with_jacobians(rays)
    assert np.abs(sheet.distances(points)).max() < 1e-15
    assert np.abs(np.cross(points, rays)).max() < 1e-15
    step = 1e-7
    for k in range(3):
        moved = sheet.intersect(rays + step * np.eye(3)[k])
        assert (moved - points) / step == pytest.approx(by_ray[:, :, k], rel=1e-4, abs=1e-5)
    moved = replace(sheet, distance=sheet.distance + step).intersect(rays)
    assert (moved - points) / step == pytest.approx(by_distance, rel=1e-4)


def test_one_parameter_more_is_what_it_would_be_if_it_were_free():
    _, joint = solved(0.0, 3)
    distance, priors = PLANE.stop - 1, joint.adjusted.priors
    held = joint.free.copy()
    held[distance] = False
    problem = Adjustment(joint.views, held, priors)
    plane = joint.adjusted.state.plane
    off = replace(joint.adjusted.state, plane=replace(plane, distance=plane.distance + 10e-6))
    there = problem.solve(off, variance_rounds=0).state
    more = one_more(problem, there, "stripe", lambda k, rows: rows[:, distance])
    free = Adjustment(joint.views, joint.free, priors).solve(there, variance_rounds=0)
    assert more.value == pytest.approx(free.state.plane.distance - there.plane.distance, rel=0.03)
    assert more.sigma == pytest.approx(float(np.sqrt(free.covariance[distance, distance])), rel=0.01)
    moved = free.state.camera.parameters - there.camera.parameters
    assert more.gain[:8] * more.value == pytest.approx(moved[:8], rel=0.06, abs=1e-6)
    # What the parameters that are free already can do together is nothing more, however little of it they leave.
    whole = Adjustment(joint.views, joint.free, priors)
    stripes = [rows for k in range(len(whole.views)) for name, rows, *_ in whole.rows_of(k, there) if name == "stripe"]
    plane_rows = np.concatenate(stripes)[:, PLANE]
    for way in np.linalg.eigh(plane_rows.T @ plane_rows)[1].T:
        assert one_more(whole, there, "stripe", lambda k, rows, way=way: rows[:, PLANE] @ way).sigma == np.inf

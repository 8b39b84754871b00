"""Promises of the calibration, on observations of a head that is drawn independently of it, with known noise."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cell.measure.calibration.solve.results import PARAMETERS, ScanCalibration, TargetCalibration, adjust_scan
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.poses import difference, from_matrix
from drivers.errors import RefusedError
from lab.bench.calibration.campaign import observe
from lab.bench.calibration.world import Noise

ALONG = np.array([1.0, 0.0, 0.0])


def test_the_scan_head_is_found_within_its_stated_deviations(world, solved):
    found = solved.calibration.scan
    sigma = dict(zip(PARAMETERS, np.sqrt(np.diag(found.covariance)), strict=True))
    error = dict(zip(PARAMETERS[:9], found.camera.parameters - world.lens, strict=True))
    error |= dict(zip(("rail x", "rail y", "rail z"), found.rail_direction - world.rail, strict=True))
    moved = difference(found.flange_from_camera, from_matrix(world.hand))
    error |= dict(zip(PARAMETERS[15:21], moved, strict=True))
    # (n, d) and (−n, −d) are one plane.
    error["plane distance"] = abs(found.light_plane.distance) - 1 / np.linalg.norm(world.plane)
    z = np.array([error[name] / sigma[name] for name in error if sigma[name] > 0])
    assert np.sqrt(np.mean(z**2)) < 1.8 and np.abs(z).max() < 4.0


def test_a_stored_calibration_round_trips(solved):
    scan = solved.calibration.scan
    stored = json.loads(json.dumps(scan.as_dict(), allow_nan=False))
    back = ScanCalibration.from_dict(stored)
    assert (back.camera, back.quality) == (scan.camera, scan.quality)
    np.testing.assert_allclose(back.light_plane.n, scan.light_plane.n, atol=1e-12)
    np.testing.assert_allclose(back.covariance, scan.covariance)
    np.testing.assert_allclose(back.flange_from_camera.homogeneous, scan.flange_from_camera.homogeneous, atol=1e-12)
    with pytest.raises((KeyError, TypeError, ValueError)):
        ScanCalibration.from_dict({"camera": stored["camera"]})


def test_chi_squared_says_that_the_assumed_noise_is_the_real_one(solved):
    quality = solved.calibration.scan.quality
    assert 0.8 < quality.chi2_per_dof < 1.2
    assert quality.dots_rms_px == pytest.approx(Noise().dots, rel=0.15)
    # Held-out views carry the arm's repeatability too: .05 mm at .13 m are .6 px.
    assert quality.held_out_px < 1.5 and quality.held_out_stripe < 0.2e-3


def test_without_noise_the_truth_comes_out(world, archived):
    noise = replace(Noise(), dots=1e-9, stripe=1e-9, rail=1e-12, arm=1e-12, arm_angle=1e-12)
    exact = [
        replace(
            o, view=replace(o.view, sigma=0.05 + o.view.sigma), profile=replace(o.profile, sigma=0.07 + o.profile.sigma)
        )
        for o in observe(world, noise, np.random.default_rng(3))
    ]
    found = ScanCalibration.of(adjust_scan(exact, archived.scan_camera, ALONG, archived.priors))
    assert abs(abs(found.light_plane.n @ world.plane) / np.linalg.norm(world.plane) - 1) < 1e-8
    assert np.linalg.norm(found.flange_from_camera.translation - world.hand[:3, 3]) < 1e-4
    assert found.quality.dots_rms_px < 0.01


def test_the_target_camera_is_found(world, solved):
    found, true = solved.calibration.target, CameraModel(640, 480, 1.0, 1.0, 0.0, 0.0).with_parameters(world.lens)
    # Apart, camera and hand-eye are known less well than together: judge where they put a board.
    pixels = true.project(np.array([[0.01, 0.01, 0.13]]))

    def seen(camera, hand):
        return hand.act(camera.rays(pixels)[0] * 0.13)

    off = seen(found.camera, found.flange_from_camera) - seen(true, from_matrix(world.hand))
    assert np.linalg.norm(off) < 0.3e-3
    assert np.sqrt(found.hand_eye_covariance.diagonal()[:3]).max() < 0.5e-3


def test_the_target_cameras_covariance_counts_the_scatter_of_the_arm_that_was_found(solved):
    calm, rough = (
        TargetCalibration.of(replace(solved.target, adjusted=replace(solved.target.adjusted, excess={"turn": times})))
        for times in (1.0, 3.0)
    )
    np.testing.assert_allclose(rough.hand_eye_covariance, 9.0 * calm.hand_eye_covariance)


def test_views_from_one_side_do_not_make_a_camera(archived):
    with pytest.raises(RefusedError):
        adjust_scan([archived.scan[0]] * 2, archived.scan_camera, ALONG, archived.priors)

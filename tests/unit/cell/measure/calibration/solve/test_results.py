"""Promises of the calibration, on observations made here by OpenCV's projection of circles, with known noise."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pinocchio as pin
import pytest

from cell.measure.calibration import Priors, ScanObservation, TargetCalibration, TargetObservation
from cell.measure.calibration.solve.results import PARAMETERS, ScanCalibration, adjust_scan, adjust_target
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import difference, from_parts, perturbed
from cell.measure.vision.board.view import BoardView, centre_of, parse_board
from cell.measure.vision.stripe.profile import StripeProfile
from drivers.errors import RefusedError
from lab.paper.rig import from_axes

BOARD = parse_board("marked_dots:11x9:3mm")
CAMERA = CameraModel(640, 480, 1675.0, 1668.0, 324.0, 236.0, (-0.09, 0.12, 8e-4, -6e-4, 0.0))
NOMINAL = CameraModel(640, 480, 1666.7, 1666.7, 319.5, 239.5)
PLANE = LightPlane.of((0.9602, 0.0052, -0.2791), -0.0338)
RAIL = np.array([0.9995, 0.004, -0.003])
FLANGE_FROM_CAMERA = perturbed(
    from_axes((0.09, -0.05, 0.08), x=(0, 1, 0), z=(0, 0, 1)), (1e-3, -8e-4, 1.2e-3, 0.008, -0.006, 0.01)
)
BASE_FROM_BOARD = perturbed(
    from_axes((-0.56, 0.26, 0.02), x=(1, 0, 0), z=(0, 0, -1)), (2e-3, 1e-3, -1e-3, 0.004, 0.002, 0.01)
)
DOTS_PX, STRIPE_PX, RAIL_M, ARM_M, ARM_RAD = 0.03, 0.07, 2e-5, 5e-5, 1e-4


def seen_dots(camera: CameraModel, camera_from_board: pin.SE3, radius: float, points: np.ndarray) -> np.ndarray:
    """Centres of the ellipses that OpenCV fits to the projected rims of the dots."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(24)])
    rotation = cv2.Rodrigues(camera_from_board.rotation)[0]
    rims = (points[:, None] + rim).reshape(-1, 3)
    pixels, _ = cv2.projectPoints(rims, rotation, camera_from_board.translation, camera.matrix, np.array(camera.dist))
    # fitEllipse works in single precision: about the middle it has digits to spare.
    centres = []
    for ring in pixels.reshape(len(points), 24, 2):
        middle = ring.mean(axis=0)
        centres.append(middle + cv2.fitEllipseDirect((64 * (ring - middle)).astype(np.float32))[0] / np.array(64.0))
    return np.array(centres)


def seen_stripe(camera: CameraModel, plane: LightPlane, camera_from_board: pin.SE3) -> np.ndarray:
    """Column (h,) of the stripe in each row, from points along the line where light plane and board meet."""
    normal = camera_from_board.rotation[:, 2]
    distance = normal @ camera_from_board.translation
    along = np.cross(plane.n, normal)
    at = np.linalg.lstsq(np.array([plane.n, normal, along]), np.array([plane.distance, distance, 0.0]), rcond=None)[0]
    middle = at + along * (along @ (camera_from_board.translation - at)) / (along @ along)
    line = middle + np.linspace(-0.05, 0.05, 2001)[:, None] * along / np.linalg.norm(along)
    pixels, _ = cv2.projectPoints(line, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.dist))
    pixels = pixels[:, 0][np.argsort(pixels[:, 0, 1])]
    columns = np.interp(np.arange(480), pixels[:, 1], pixels[:, 0], left=np.nan, right=np.nan)
    columns[(columns < 5) | (columns > 634)] = np.nan
    return columns


def observe(rng: np.random.Generator, count: int = 24, noise: float = 1.0) -> list[ScanObservation]:
    """Views at several distances, tilts, turns and rail positions, as a cell would collect them."""
    made = []
    points = BOARD.points()
    for k in range(count):
        tilt = np.radians(rng.uniform(8, 28)) * np.array([np.cos(k * 2.4), np.sin(k * 2.4), 0])
        rotation = pin.exp3(tilt) @ pin.exp3(np.array([0, 0, rng.uniform(-0.4, 0.4)]))
        centre = np.array([rng.uniform(-0.004, 0.004), rng.uniform(-0.003, 0.003), rng.uniform(0.118, 0.145)])
        wanted = from_parts(centre - rotation @ centre_of(BOARD), rotation)
        s = float(rng.uniform(0.0, 0.1))
        flange = BASE_FROM_BOARD * (FLANGE_FROM_CAMERA * from_parts(s * RAIL) * wanted).inverse()
        reported = perturbed(flange, np.repeat([ARM_M, ARM_RAD], 3) * rng.normal(size=6) * noise)
        pixels = seen_dots(CAMERA, wanted, BOARD.dot_radius, points) + rng.normal(0, DOTS_PX * noise, (len(points), 2))
        inside = ((pixels > 12) & (pixels < (627, 467))).all(axis=1)
        ids = np.flatnonzero(inside)
        view = BoardView(BOARD, (640, 480), ids, pixels[ids], np.full(len(ids), DOTS_PX), dot_radius=BOARD.dot_radius)
        stripe = seen_stripe(CAMERA, PLANE, wanted) + rng.normal(0, STRIPE_PX * noise, 480)
        nothing = np.zeros(480, dtype=bool)
        profile = StripeProfile(
            "rows", stripe, np.full(480, STRIPE_PX), np.full(480, 150.0), np.full(480, 1.5), nothing, nothing
        )
        position = s + float(rng.normal(0, RAIL_M * noise))
        made.append(ScanObservation(view, profile, reported, position))
    return made


PRIORS = Priors(arm_translation=ARM_M, arm_rotation=ARM_RAD, rail=RAIL_M)


def calibrated(observations: list[ScanObservation]) -> ScanCalibration:
    return ScanCalibration.of(adjust_scan(observations, NOMINAL, np.array([1.0, 0, 0]), PRIORS))


@pytest.fixture(scope="module")
def scan():
    return calibrated(observe(np.random.default_rng(5)))


def test_the_scan_head_is_found_within_its_stated_deviations(scan):
    calibration = scan
    sigma = dict(zip(PARAMETERS, np.sqrt(np.diag(calibration.covariance)), strict=True))
    error = dict(zip(PARAMETERS[:9], calibration.camera.parameters - CAMERA.parameters, strict=True))
    error |= dict(zip(("rail x", "rail y", "rail z"), calibration.rail_direction - RAIL, strict=True))
    moved = difference(calibration.flange_from_camera, FLANGE_FROM_CAMERA)
    error |= dict(zip(PARAMETERS[15:21], moved, strict=True))
    # (n, d) and (−n, −d) are one plane.
    error["plane distance"] = abs(calibration.light_plane.distance) - abs(PLANE.distance)
    z = np.array([error[name] / sigma[name] for name in error if sigma[name] > 0])
    assert np.sqrt(np.mean(z**2)) < 1.8 and np.abs(z).max() < 4.0


def test_a_stored_calibration_round_trips(scan):
    stored = json.loads(json.dumps(scan.as_dict(), allow_nan=False))
    back = ScanCalibration.from_dict(stored)
    assert (back.camera, back.quality) == (scan.camera, scan.quality)
    np.testing.assert_allclose(back.light_plane.n, scan.light_plane.n, atol=1e-12)
    np.testing.assert_allclose(back.covariance, scan.covariance)
    np.testing.assert_allclose(back.flange_from_camera.homogeneous, scan.flange_from_camera.homogeneous, atol=1e-12)
    with pytest.raises((KeyError, TypeError, ValueError)):
        ScanCalibration.from_dict({"camera": stored["camera"]})


def test_chi_squared_says_that_the_assumed_noise_is_the_real_one(scan):
    quality = scan.quality
    assert 0.8 < quality.chi2_per_dof < 1.2
    assert quality.dots_rms_px == pytest.approx(DOTS_PX, rel=0.15)
    # Held-out views carry the arm's repeatability too: .05 mm at .13 m are .6 px.
    assert quality.held_out_px < 1.5 and quality.held_out_stripe < 0.2e-3


def test_without_noise_the_truth_comes_out():
    exact = calibrated(observe(np.random.default_rng(2), 16, noise=0.0))
    assert abs(abs(exact.light_plane.n @ PLANE.n) - 1) < 1e-8
    assert np.linalg.norm(exact.flange_from_camera.translation - FLANGE_FROM_CAMERA.translation) < 1e-4
    assert exact.quality.dots_rms_px < 0.01


def test_the_target_camera_is_found():
    camera = CameraModel(1280, 1024, 1672.0, 1667.0, 643.0, 508.0, (-0.08, 0.1, 5e-4, -4e-4, 0.0))
    board = parse_board("marked_dots:9x7:20mm")
    rng = np.random.default_rng(3)
    hand = perturbed(from_axes((-0.10, 0, 0.03), x=(0, 1, 0), z=(0, 0, 1)), (1e-3, 2e-3, -1e-3, 0.01, 0.005, -0.008))
    made = []
    for k in range(16):
        tilt = np.radians(rng.uniform(10, 40)) * np.array([np.cos(k * 2.4), np.sin(k * 2.4), 0])
        rotation = pin.exp3(tilt) @ pin.exp3(np.array([0, 0, rng.uniform(-1, 1)]))
        centre = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.5, 0.8)])
        seen = from_parts(centre - rotation @ centre_of(board), rotation)
        flange = perturbed(
            BASE_FROM_BOARD * (hand * seen).inverse(), np.repeat([ARM_M, ARM_RAD], 3) * rng.normal(size=6)
        )
        pixels = seen_dots(camera, seen, board.dot_radius, board.points()) + rng.normal(0, 0.03, (63, 2))
        view = BoardView(board, (1280, 1024), np.arange(63), pixels, np.full(63, 0.03), dot_radius=board.dot_radius)
        made.append(TargetObservation(view, flange))
    nominal = CameraModel(1280, 1024, 1666.7, 1666.7, 639.5, 511.5)
    found = TargetCalibration.of(adjust_target(made, nominal, PRIORS))
    # Apart, camera and hand-eye are known less well than together: judge where they put a board.
    reach = from_parts((-0.08, -0.06, 0.65))
    pixels = camera.project(reach.act(np.array([0.08, 0.06, 0.0]))[None])

    def ray(c, h):
        return h.rotation @ c.rays(pixels)[0] * 0.65 + h.translation

    assert np.linalg.norm(ray(found.camera, found.flange_from_camera) - ray(camera, hand)) < 0.3e-3
    assert np.sqrt(found.hand_eye_covariance.diagonal()[:3]).max() < 0.5e-3


def test_views_from_one_side_do_not_make_a_camera():
    view = observe(np.random.default_rng(6), 1)[0]
    with pytest.raises(RefusedError):
        calibrated([view] * 2)

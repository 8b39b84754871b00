"""Stripes that are no line, or lie in no plane with the others, are named; a plane is as sure as it scatters."""

import numpy as np
import pytest

from cell.measure.calibration.judge.plane_checks import (
    PlaneKnown,
    crooked,
    odd_stripes,
    plane_checks,
    planes_without_one,
)
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane

CAMERA = CameraModel(640, 480, 800.0, 800.0, 320.0, 240.0, (-0.2, 0.05, 0.0, 0.0, 0.0))
PLANE = LightPlane.of((1.0, 0.02, -0.3), -0.035)


def stripes(plane: LightPlane, count: int, sigma: float = 2e-5) -> list[np.ndarray]:
    """Stripes (n, 3) on boards across the optical axis, at as many distances, with noise of the plane's place."""
    rng, made = np.random.default_rng(count), []
    for z in np.linspace(0.12, 0.2, count):
        y = np.linspace(-0.02, 0.02, 60)
        x = (plane.distance - plane.n[1] * y - plane.n[2] * z) / plane.n[0] + sigma * rng.normal(size=60)
        made.append(np.column_stack([x, y, np.full(60, z)]))
    return made


@pytest.mark.parametrize(("sag", "straight"), [(0.0, True), (1.0, True), (40.0, False)])
def test_a_stripe_that_is_no_straight_line_on_its_board_is_named(sag, straight):
    ideal = np.column_stack([0.1 + sag / 800 * np.linspace(-1, 1, 200) ** 2, np.linspace(-0.2, 0.2, 200), np.ones(200)])
    why = crooked(CAMERA, CAMERA.project(ideal), np.full(200, 0.1))
    assert (why is None) == straight
    assert straight or ("not straight on the board: 1" in why and "its own noise is 0.10 px" in why)


def test_a_stripe_of_another_line_is_named_with_its_distance_and_the_rest_are_not():
    clouds = stripes(PLANE, 7)
    assert odd_stripes(clouds) == {}
    clouds[3] = clouds[3] + (0.015, 0.0, 0.0)
    assert list(odd_stripes(clouds)) == [3]
    assert "its stripe lies 14." in odd_stripes(clouds)[3]


def test_a_plane_is_as_sure_as_it_is_without_each_frame_and_one_that_scatters_is_refused():
    known = []
    for sigma in (2e-5, 6e-3):
        clouds = stripes(PLANE, 6, sigma)
        cloud = np.concatenate(clouds)
        plane = LightPlane.fit(cloud)
        known.append(PlaneKnown.of(plane, planes_without_one(clouds), cloud))
        rms = float(np.sqrt(np.mean(plane.distances(cloud) ** 2)))
        verdicts = {check.name: check.verdict for check in plane_checks(rms, 2e-5, cloud, 6, known[-1])}
        fits = verdicts["RMS of the stripe's points"]
        assert fits == ("ok" if sigma < 1e-3 else "refused")
    few = [check.name for check in plane_checks(2e-5, 2e-5, cloud, 0, known[0])]
    assert "frames that are missing" in few and "stripes that are left out" not in few
    # Of 360 points a plane is known to about σ √(3/360).
    assert known[0].place == pytest.approx(2e-5 * np.sqrt(3 / 360), rel=0.8)
    assert known[1].place > 50 * known[0].place and known[1].tilt > 50 * known[0].tilt

"""Acceptance figures: form, size and spacing against shapes with known errors, and against a head without any."""

from __future__ import annotations

import numpy as np
import pytest

from cell.measure.geometry.light_plane import LightPlane
from cell.measure.reconstruction.build import ScanGeometry
from drivers.errors import RefusedError
from lab.bench.acceptance import campaign
from lab.bench.calibration.world import Noise
from lab.paper.rig import RigSpec, draw_head
from sim_backends.world.levels import LEVELS


def ball(count: int = 3000, radius: float = 0.0075) -> np.ndarray:
    """Points of a ball's cap within 50° of −z, evenly spread."""
    rng = np.random.default_rng(2)
    cosine = rng.uniform(np.cos(np.radians(50)), 1, count)
    angle = rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - cosine**2)
    return np.array([0.05, 0.01, 0.13]) + radius * np.column_stack(
        [sine * np.cos(angle), sine * np.sin(angle), -cosine]
    )


def test_a_perfect_sphere_is_found_and_has_no_form_error() -> None:
    fit = campaign.fit_sphere(ball())
    np.testing.assert_allclose(fit.centre, [0.05, 0.01, 0.13], atol=1e-12)
    assert fit.radius == pytest.approx(0.0075, abs=1e-12)
    assert campaign.form_all(fit.deviations) < 1e-11


def test_the_sphere_fit_minimises_the_distances_of_noisy_points() -> None:
    points = ball() + 2e-5 * np.random.default_rng(3).normal(size=(3000, 3))
    fit = campaign.fit_sphere(points)

    def squares(centre: np.ndarray, radius: float) -> float:
        return float(np.sum((np.linalg.norm(points - centre, axis=1) - radius) ** 2))

    least = squares(fit.centre, fit.radius)
    for step in 1e-6 * np.eye(4):
        for sign in (-1, 1):
            assert squares(fit.centre + sign * step[:3], fit.radius + sign * step[3]) > least


def test_form_errors_of_a_uniform_band_are_its_width() -> None:
    deviations = np.linspace(-1e-5, 3e-5, 10_001)
    assert campaign.form_95(deviations) == pytest.approx(0.95 * 4e-5, rel=1e-3)
    assert campaign.form_all(deviations) == pytest.approx(0.997 * 4e-5, rel=1e-3)


def test_three_points_in_a_thousand_are_let_go_and_no_more() -> None:
    deviations = np.concatenate([np.linspace(-1e-5, 1e-5, 997), [1e-3, -2e-3, 3e-3]])
    assert campaign.form_all(deviations) == pytest.approx(2e-5)
    assert campaign.form_all(np.concatenate([deviations[3:], [4e-3] * 3])) > 1e-3


def test_flatness_does_not_depend_on_the_pose() -> None:
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-1, 1, (500, 2)), 1e-3 * rng.uniform(-1, 1, 500)])
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert campaign.form_95(campaign.plane_deviations(points @ turn.T + 5)) == pytest.approx(
        campaign.form_95(campaign.plane_deviations(points)), rel=1e-9
    )


def test_the_cap_is_cut_at_its_angle() -> None:
    directions = np.array([[0, 0, -1.0], [np.sin(0.8), 0, -np.cos(0.8)], [np.sin(0.9), 0, -np.cos(0.9)]])
    assert campaign.cap(directions, np.zeros(3), np.array([0, 0, -2.0]), 0.85).tolist() == [True, True, False]


def test_too_few_points_are_refused() -> None:
    with pytest.raises(RefusedError, match="50 are needed"):
        campaign.fit_sphere(ball(20))


@pytest.fixture(scope="module")
def exact():
    """A head without deviations or noise but the sensor's, and its true geometry."""
    spec = RigSpec(noise=Noise().times(1e-3))
    head = draw_head(spec, np.random.default_rng(1), "ideal")
    camera = spec.nominal_camera()
    plane = LightPlane.of(head.laser.normal, head.laser.distance)
    import pinocchio as pin

    return spec, head, ScanGeometry(camera, plane, head.rail_direction, pin.SE3.Identity())


def test_a_head_that_is_known_exactly_measures_the_artefacts_true(exact) -> None:
    spec, head, geometry = exact
    rng = np.random.default_rng(0)
    ends = campaign.bar_places(spec)[5]
    clouds = campaign.scan_balls(spec, head, geometry, list(ends), rng)
    assert abs(campaign._spacing(clouds, campaign.SPACING)["spacing_mm"]) < 0.004
    probing = campaign._probing(clouds[0], campaign.BALL_DIAMETER)
    assert abs(probing["size_mm"]) < 0.006
    # The sensor alone, without speckle: some hundredths of a pixel, at 0.3 mm of depth each.
    assert probing["form_95_mm"] < 0.05
    flat = campaign._flatness(campaign.scan_flat(spec, head, geometry, campaign.flat_poses(spec)[4], rng))
    assert flat["form_95_mm"] < 0.05


def test_a_wrong_scale_of_the_rail_shows_in_the_spacing(exact) -> None:
    spec, head, geometry = exact
    wrong = ScanGeometry(
        geometry.camera, geometry.light_plane, 1.002 * geometry.rail_direction, geometry.flange_from_camera
    )
    ends = campaign.bar_places(spec)[0]
    clouds = campaign.scan_balls(spec, head, wrong, list(ends), np.random.default_rng(0))
    assert campaign._spacing(clouds, campaign.SPACING)["spacing_mm"] == pytest.approx(0.1, abs=0.01)


def test_places_cover_the_volume_as_the_standard_asks() -> None:
    spec = RigSpec()
    assert len(campaign.ball_places(spec)) == 10
    bars = campaign.bar_places(spec)
    assert len(bars) == 7
    for first, second in bars:
        assert np.linalg.norm(second - first) == pytest.approx(campaign.SPACING)
    assert len(campaign.flat_poses(spec)) == 6


def test_every_level_has_its_noise() -> None:
    assert set(campaign.NOISE_FACTOR) == set(LEVELS)

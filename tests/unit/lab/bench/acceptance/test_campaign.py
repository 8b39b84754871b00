"""Acceptance figures: form, size and spacing against shapes with known errors, and against a head without any."""

import numpy as np
import pinocchio as pin
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


def test_the_sphere_fit_minimises_the_distances_of_noisy_points():
    points = ball() + 2e-5 * np.random.default_rng(3).normal(size=(3000, 3))
    fit = campaign.fit_sphere(points)

    def squares(centre: np.ndarray, radius: float) -> float:
        return float(np.sum((np.linalg.norm(points - centre, axis=1) - radius) ** 2))

    least = squares(fit.centre, fit.radius)
    for step in 1e-6 * np.eye(4):
        for sign in (-1, 1):
            assert squares(fit.centre + sign * step[:3], fit.radius + sign * step[3]) > least


def test_three_points_in_a_thousand_are_let_go_and_no_more():
    deviations = np.concatenate([np.linspace(-1e-5, 1e-5, 997), [1e-3, -2e-3, 3e-3]])
    assert campaign.form_all(deviations) == pytest.approx(2e-5)
    assert campaign.form_all(np.concatenate([deviations[3:], [4e-3] * 3])) > 1e-3


def test_too_few_points_are_refused():
    with pytest.raises(RefusedError, match="50 are needed"):
        campaign.fit_sphere(ball(20))


@pytest.fixture(scope="module")
def exact():
    """A head without deviations or noise but the sensor's, and its true geometry."""
    spec = RigSpec(noise=Noise().times(1e-3))
    head = draw_head(spec, np.random.default_rng(1), "ideal")
    plane = LightPlane.of(head.laser.normal, head.laser.distance)
    return spec, head, ScanGeometry(spec.nominal_camera(), plane, head.rail_direction, pin.SE3.Identity())


def test_a_head_that_is_known_exactly_measures_the_artefacts_true(exact):
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


def test_a_wrong_scale_of_the_rail_shows_in_the_spacing(exact):
    spec, head, geometry = exact
    wrong = ScanGeometry(
        geometry.camera, geometry.light_plane, 1.002 * geometry.rail_direction, geometry.flange_from_camera
    )
    ends = campaign.bar_places(spec)[0]
    clouds = campaign.scan_balls(spec, head, wrong, list(ends), np.random.default_rng(0))
    assert campaign._spacing(clouds, campaign.SPACING)["spacing_mm"] == pytest.approx(0.1, abs=0.01)


def test_places_cover_the_volume_as_the_standard_asks():
    spec = RigSpec()
    bars = campaign.bar_places(spec)
    counts = len(campaign.ball_places(spec)), len(bars), len(campaign.flat_poses(spec))
    assert counts == (10, 7, 6) and sum(counts) == campaign.PLACES
    for first, second in bars:
        assert np.linalg.norm(second - first) == pytest.approx(campaign.SPACING)


def test_every_level_has_its_noise():
    assert set(campaign.NOISE_FACTOR) == set(LEVELS)

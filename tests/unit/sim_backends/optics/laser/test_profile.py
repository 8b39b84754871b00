"""Promises of the stripe's light: how bright it is, and what speckle does to it."""

import numpy as np
import pytest

from sim_backends.optics import PlaneInstance, expected_image, render
from tests.support.simulator.stripe_scene import CLEAN, DARK, LASER, OPTICS, centroids, facing, stripe


def test_brightness_follows_exposure_distance_incidence_and_albedo():
    def peak(distance, albedo, exposure, tilt=0.0):
        image = expected_image(
            OPTICS, [PlaneInstance(facing([0.0, tilt, 0.0], distance), (0.2, 0.2), albedo)], CLEAN, exposure,
            np.random.default_rng(0), DARK,
        )  # fmt: skip
        return image[240].sum()

    reference = peak(0.130, 0.9, 0.002)
    assert peak(0.130, 0.9, 0.004) == pytest.approx(2 * reference, rel=1e-4)
    assert peak(0.130, 0.3, 0.002) == pytest.approx(reference / 3, rel=1e-4)
    # Light in a row: the line is 1/R as bright per length and its image 1/Z as wide.
    assert peak(0.140, 0.9, 0.002) == pytest.approx(reference * (0.130 / 0.140) ** 2, rel=0.01)


def test_speckle_moves_centres_by_what_recordings_show():
    scene = [PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)]
    quiet = centroids(stripe(scene))[0]
    shifts = np.concatenate([centroids(stripe(scene, LASER, seed=s))[0] - quiet for s in range(6)])
    assert 0.05 < shifts.std() < 0.08
    assert abs(shifts.mean()) < 0.005
    ratio = stripe(scene, LASER, seed=1) / np.maximum(stripe(scene), 1e-9)
    bright = stripe(scene) > 20
    assert ratio[bright].std() == pytest.approx(LASER.speckle_contrast, rel=0.1)
    assert ratio[bright].mean() == pytest.approx(1.0, abs=0.02)


def test_speckle_is_correlated_between_neighbours_and_new_in_every_frame():
    scene = [PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)]
    quiet = centroids(stripe(scene))[0]
    first, second = (centroids(stripe(scene, LASER, seed=s))[0] - quiet for s in (1, 2))
    assert np.corrcoef(first[1:], first[:-1])[0, 1] > 0.1
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.15


def test_the_stripe_saturates_and_the_laser_can_be_off():
    scene = [PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)]
    rng = np.random.default_rng(0)
    assert (render(OPTICS, scene, LASER, 0.008, rng).max(axis=1) == 255).all()
    assert render(OPTICS, scene, None, 0.002, rng).max() < 40

"""The profile that lines share is learned from a picture, and comes near its own bound."""

import numpy as np
import pytest

from cell.measure.vision.stripe.extract import StripeStream
from lab.bench.stripe.campaign import measure_scene, within_limits
from lab.bench.stripe.workshop import Scene, draw


def test_in_a_stream_the_profile_of_a_block_is_that_of_its_first_picture():
    pictures = [draw(Scene("flat top", 2.0), seed) for seed in range(3)]
    stream = StripeStream()
    profiles = [stream.extract(image) for image, _ in pictures]
    assert profiles[0].learned is not None
    assert profiles[1].learned is profiles[2].learned is profiles[0].learned
    for profile, (_, centres) in zip(profiles, pictures, strict=True):
        assert np.sqrt(np.mean((profile.centres - centres) ** 2)) < 0.021


@pytest.mark.parametrize(
    "scene",
    [
        Scene("flat top", 2.0),
        Scene("halo", 2.0),
        Scene("one-sided", 3.0),
        Scene("flat top", 12.0),
        Scene("Gaussian", 30.0),
        Scene("flat top", 30.0),
        Scene("one-sided", 30.0),
        Scene("Gaussian", 0.6),
        Scene("Gaussian", 2.0, camera="12 bit low"),
        Scene("Gaussian", 2.0, camera="12 bit high"),
        Scene("Gaussian", 2.0, camera="green"),
        Scene("Gaussian", 2.0, texture=8.0),
    ],
    ids=lambda scene: f"{scene.name} {scene.width}",
)
def test_every_stripe_comes_near_its_own_bound_with_a_true_deviation(scene):
    row = measure_scene(scene, seed=5)
    assert within_limits(row), row

"""Promises of `lab.bench.stripe.profiles`."""

from __future__ import annotations

import pytest

from lab.bench.stripe.profiles import measure, within_limits
from lab.bench.stripe.workshop import Scene


@pytest.mark.parametrize(
    "scene",
    [
        Scene("flat top", 2.0),
        Scene("halo", 2.0),
        Scene("one-sided", 3.0),
        Scene("flat top", 12.0),
        Scene("Gaussian", 30.0),
        Scene("flat top", 30.0),
        Scene("halo", 30.0),
        Scene("one-sided", 30.0),
        Scene("Gaussian", 0.6),
        Scene("Gaussian", 2.0, camera="12 bit low"),
        Scene("Gaussian", 2.0, camera="12 bit high"),
        Scene("Gaussian", 2.0, camera="red"),
        Scene("Gaussian", 2.0, camera="green"),
        Scene("Gaussian", 2.0, texture=8.0),
    ],
    ids=lambda scene: f"{scene.name} {scene.width}",
)
def test_every_stripe_comes_near_its_own_bound_with_a_true_deviation(scene):
    row = measure(scene, seed=5)
    assert within_limits(row), row

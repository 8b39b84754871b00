"""Promises of `sim_backends.world.scene`."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lab.bench.stripe.profiles import measure, within_limits
from lab.bench.stripe.workshop import Scene, draw
from sim_backends.world.scene import draw, stream


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


def flat(value: object) -> np.ndarray:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return np.concatenate([flat(getattr(value, f.name)) for f in dataclasses.fields(value)])
    if isinstance(value, str | dict):
        return np.zeros(0)
    return np.asarray(value, dtype=float).ravel()


def test_a_seed_fixes_the_whole_world_and_another_changes_it() -> None:
    assert (flat(draw(7, "nominal")) == flat(draw(7, "nominal"))).all()
    a, b = draw(7, "nominal"), draw(8, "nominal")
    for name in ("world_from_surface", "flange_from_scan_camera", "light_plane_normal", "dh_error", "rail_direction"):
        assert np.abs(getattr(a, name) - getattr(b, name)).max() > 0, name


def test_each_quantity_has_a_stream_of_its_own() -> None:
    a, b = stream(3, "light_plane.tilt"), stream(3, "light_plane.offset")
    assert abs(np.corrcoef(a.standard_normal(2000), b.standard_normal(2000))[0, 1]) < 0.1

"""Promises of `sim_backends.world.scene`."""

import dataclasses

import numpy as np

from sim_backends.world.scene import draw


def flat(value: object) -> np.ndarray:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return np.concatenate([flat(getattr(value, f.name)) for f in dataclasses.fields(value)])
    if value is None or isinstance(value, str | dict):
        return np.zeros(0)
    return np.asarray(value, dtype=float).ravel()


def test_a_seed_fixes_the_whole_world_and_another_changes_it():
    assert (flat(draw(7, "nominal")) == flat(draw(7, "nominal"))).all()
    a, b = draw(7, "nominal"), draw(8, "nominal")
    for name in ("world_from_surface", "flange_from_scan_camera", "light_plane_normal", "dh_error", "rail_direction"):
        assert np.abs(getattr(a, name) - getattr(b, name)).max() > 0, name

"""Promises of `sim_backends.optics.pattern`."""

import numpy as np

from sim_backends.optics.pattern import grain_at, grain_parameters
from sim_backends.optics.scene import Grain


def test_dust_shades_a_few_places():
    pattern = grain_parameters(0.6, Grain(spots=1.0))
    x, y = np.meshgrid(np.arange(-0.03, 0.03, 1e-4), np.arange(-0.03, 0.03, 1e-4))
    albedo = np.array([grain_at(a, b, pattern) for a, b in zip(x.ravel(), y.ravel(), strict=True)])
    dark = float(np.mean(albedo < 0.3))
    # 36 spots of 0.4 to 1 mm across on 36 cm², give or take.
    assert 0.001 < dark < 0.008

"""Promises of the simulated lens and sensor."""

import numpy as np
import pytest

from sim_backends.optics import PlaneInstance, sensor
from tests.support.simulator.optics_scene import SCAN, expose, pose


def test_a_board_out_of_focus_is_blurred_by_the_thin_lens_formula():
    # The scan camera, focused at 130 mm, blurs a point at 1 m over a disc of 24 px (docs/explanation/theory.md, section
    # 4).
    disc = 8e-3 / 4 * 8e-3 * 0.87 / (1.0 * 0.122) / 4.8e-6
    assert disc == pytest.approx(23.8, abs=0.1)
    assert float(SCAN.blur_px(1.0)) == pytest.approx(np.hypot(0.6, disc / 4))
    edge = PlaneInstance(pose([0, 0, 0], [0.1, 0.0, 1.0]), (0.2, 2.0), 0.9)
    profile = expose(SCAN, [edge], 0.020)[240]
    slope = np.diff(profile)
    column = np.arange(len(slope)) + 0.5
    centre = (slope * column).sum() / slope.sum()
    spread = np.sqrt((slope * (column - centre) ** 2).sum() / slope.sum())
    assert spread == pytest.approx(np.hypot(0.6, disc / 4), rel=0.03)


@pytest.mark.parametrize("level", [2.25, 60.0, 200.0])
def test_sensor_noise_has_the_stated_mean_and_variance(level):
    picture = sensor(np.full((480, 640), level, np.float32), SCAN, np.random.default_rng(3)).astype(float)
    assert picture.mean() == pytest.approx(level, abs=0.01)
    assert picture.var() == pytest.approx(level / 40 + 0.4**2 + 1 / 12, rel=0.02)

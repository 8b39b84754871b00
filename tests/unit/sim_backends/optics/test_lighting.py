"""Promises of the ambient light."""

import numpy as np

from sim_backends.optics import BoardInstance, Light, PlaneInstance
from tests.support.simulator.optics_scene import FINE, LARGE, SCAN, TARGET, expose, pose


def test_boards_are_exposed_as_the_cameras_expect():
    near = BoardInstance(pose([0, 0, 0], [-0.015, -0.012, 0.130]), FINE)
    far = BoardInstance(pose([0, 0, 0], [-0.08, -0.06, 1.0]), LARGE)
    assert 170 <= expose(SCAN, [near], 0.020).max() <= 200
    assert 170 <= expose(TARGET, [far], 0.008).max() <= 200
    table = PlaneInstance(pose([0, 0, 0], [0, 0, 0.130]), (1.0, 1.0), 0.5)
    assert 8 <= np.median(expose(SCAN, [table], 0.002)) <= 15


def test_light_doubles_with_exposure_and_with_the_lamp():
    scene = [BoardInstance(pose([0.1, 0, 0], [-0.015, -0.012, 0.130]), FINE)]
    once = expose(SCAN, scene, 0.004)
    np.testing.assert_allclose(expose(SCAN, scene, 0.008), 2 * once, rtol=1e-5)
    bright = Light(level=2.0, gradient=(0.0, 0.0), diffuse=1.0)
    np.testing.assert_allclose(expose(SCAN, scene, 0.004, light=bright), 2 * once, rtol=1e-5)

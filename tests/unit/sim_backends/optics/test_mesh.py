"""Promises of meshes in the laser's light."""

import numpy as np
import pytest

from sim_backends.optics import Mesh, MeshInstance, PlaneInstance, expected_image
from tests.support.simulator.stripe_scene import OPTICS, facing, height_field, stripe


def test_a_wall_between_camera_and_stripe_hides_it():
    floor = height_field(lambda x, y: 0 * x)
    seen = MeshInstance(facing([0, 0, 0], 0.130), floor, 0.6)
    screen = facing([0, 0, 0], 0.050)
    screen[:3, 3] += [0.001, 0.0, 0.0]
    image = stripe([seen, PlaneInstance(screen, (0.004, 0.005), 0.0)])
    assert (image[225:255].sum(axis=1) < 1).all()
    assert (image[80:120].sum(axis=1) > 50).all()


def test_a_mesh_that_stands_on_a_plane_covers_it():
    # Where mesh and table touch, the stripe must not be drawn twice.
    table = PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.6)
    touching = MeshInstance(facing([0, 0, 0], 0.130), height_field(lambda x, y: 0 * x), 0.6)
    alone = stripe([touching]).sum(axis=1)
    assert np.allclose(stripe([table, touching]).sum(axis=1)[100:380], alone[100:380])


def test_wrong_meshes_and_exposures_are_refused():
    with pytest.raises(ValueError, match="triangle"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 3]]))
    with pytest.raises(ValueError, match="exposure"):
        expected_image(OPTICS, [], None, 0.0, np.random.default_rng(0))

"""What the cameras of an ideal world see is where closed forms put it."""

import numpy as np
import pytest

from sim_backends.world import drawing
from sim_backends.world.bodies.surfaces import HALF_Y, surface
from tests.support.simulator.standing_world import StandingWorld


@pytest.fixture(scope="module")
def ideal() -> StandingWorld:
    return StandingWorld()


def above(point: tuple[float, float, float]) -> np.ndarray:
    """A camera that looks straight down from `point`, its x axis along world x."""
    return drawing.pose(point, (1, 0, 0), (0, 0, -1))


def test_the_stripe_follows_the_relief(ideal: StandingWorld):
    """Each lit pixel's ray, cut with the light plane, ends on the closed form of the surface."""
    world_from_camera = above((0.0, 0.0, 0.60 + 0.130))
    light = ideal.look("scan", world_from_camera, laser=True).astype(float) - ideal.look("scan", world_from_camera)
    light[light < 4] = 0.0
    rows = np.arange(30, 450)
    u = (light[rows] * np.arange(640)).sum(axis=1) / light[rows].sum(axis=1)
    ray = np.column_stack([(u - 319.5), (rows - 239.5), np.full(len(rows), 0.008 / 4.8e-6)]) / (0.008 / 4.8e-6)
    depth = 0.035 / (1 / 3.5 - ray[:, 0])
    points = ray * depth[:, None]
    x, y, z = points[:, 0], -points[:, 1], 0.130 - points[:, 2]
    on_it = np.abs(y) < HALF_Y - 0.001
    assert on_it.sum() > 300
    assert np.sqrt(np.mean((z - surface("pot").height(x, y))[on_it] ** 2)) < 1e-4


def test_the_target_camera_sees_the_boards_dots_where_a_pinhole_puts_them(ideal: StandingWorld):
    world_from_board = drawing.WORLD_FROM_PLACE @ drawing.PLACE_FROM_BOARD
    world_from_camera = world_from_board @ drawing.pose((0.08, 0.06, -0.9), (1, 0, 0), (0, 0, 1))
    picture = ideal.look("target", world_from_camera, exposure=0.008).astype(float)
    for i, j in [(0, 0), (8, 0), (0, 6), (8, 6)]:
        u, v = (
            (np.array([i * 0.02 - 0.08, j * 0.02 - 0.06]) / 0.9 * 0.008 / 4.8e-6 + [639.5, 511.5]).round().astype(int)
        )
        patch = 190.0 - picture[v - 14 : v + 15, u - 14 : u + 15]
        patch[patch < 60] = 0.0
        at = [(patch.sum(axis=axis) * np.arange(-14, 15)).sum() / patch.sum() for axis in (0, 1)]
        exact = np.array([i * 0.02 - 0.08, j * 0.02 - 0.06]) / 0.9 * 0.008 / 4.8e-6 + [639.5, 511.5]
        assert [u + at[0], v + at[1]] == pytest.approx(exact, abs=0.05)

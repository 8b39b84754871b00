"""A station's bodies: with a mesh of the part the part's own underside, without one the surface's."""

from dataclasses import replace

import numpy as np
import pytest

from lab.bench.job.part_jobs import job_with_part
from sim_backends.world.bodies.station import Station
from sim_backends.world.bodies.surfaces import surface
from sim_backends.world.drawing import STOCK, read, settled


def test_the_underside_of_a_part_is_that_of_its_mesh(tmp_path):
    assert Station.of(STOCK.station).part is None
    job_with_part(tmp_path, "pot", lambda corners: corners - np.array([0.0, 0.0, 0.001]))
    drawn = replace(STOCK.station, part_mesh=str(tmp_path / "pot-part.ply"), part_mesh_unit="m")
    part = Station.of(drawn).part
    assert part is not None
    x, y = np.array([0.0, 0.01, -0.02]), np.array([0.0, -0.005, 0.01])
    below = surface("pot").height(x, y) - 0.001
    np.testing.assert_allclose(-part.relief(x, y)[0], below, atol=30e-6)


def test_a_mesh_that_is_none_is_told_by_its_path(tmp_path):
    with pytest.raises(ValueError, match=r"none\.stl cannot be read"):
        Station.of(replace(STOCK.station, part_mesh=str(tmp_path / "none.stl")))


def test_a_wave_lies_on_what_is_felt_and_on_what_is_seen():
    drawn = replace(STOCK, station=replace(STOCK.station, waviness=(0.1e-3, 0.012, 0.5)))
    plain, waved = Station.of(STOCK.station), Station.of(read(settled(drawn, STOCK).as_json()).station)

    def rise(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray(0.1e-3 * np.sin(2.0 * np.pi / 0.012 * (np.cos(0.5) * x + np.sin(0.5) * y)))

    x, y = np.random.default_rng(1).uniform(-0.015, 0.015, (2, 500))
    height, *slopes = np.subtract(waved.ground.relief(x, y), plain.ground.relief(x, y))
    np.testing.assert_allclose(height, rise(x, y), atol=1e-12)
    expected = [rise(x + 1e-7, y) - rise(x, y), rise(x, y + 1e-7) - rise(x, y)]
    np.testing.assert_allclose(slopes, np.array(expected) / 1e-7, atol=1e-4)
    x, y, z = plain.seen.vertices.T
    np.testing.assert_allclose(waved.seen.vertices[:, 2] - z, rise(x, y), atol=1e-12)

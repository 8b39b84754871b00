"""A station's bodies: with a mesh of the part the part's own underside, without one the surface's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.bench.job.part_jobs import job_with_part
from sim_backends.world.bodies.station import Station
from sim_backends.world.bodies.surfaces import surface
from sim_backends.world.drawing import STOCK, read, settled


def test_the_underside_of_a_part_is_that_of_its_mesh(tmp_path: Path) -> None:
    assert Station.of(STOCK.station).part is None
    job_with_part(tmp_path, "pot", lambda corners: corners - np.array([0.0, 0.0, 0.001]))
    drawn = replace(STOCK.station, part_mesh=str(tmp_path / "pot-part.ply"), part_mesh_unit="m")
    part = Station.of(drawn).part
    assert part is not None
    x, y = np.array([0.0, 0.01, -0.02]), np.array([0.0, -0.005, 0.01])
    below = surface("pot").height(x, y) - 0.001
    np.testing.assert_allclose(-part.relief(x, y)[0], below, atol=30e-6)


def test_a_mesh_that_is_none_is_told_by_its_path(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.stl cannot be read"):
        Station.of(replace(STOCK.station, part_mesh=str(tmp_path / "none.stl")))


def test_a_wave_lies_on_what_is_felt_and_on_what_is_seen() -> None:
    plain = Station.of(STOCK.station)
    wave = (0.1e-3, 0.012, 0.5)
    waved = Station.of(replace(STOCK.station, waviness=wave))
    x, y = np.random.default_rng(1).uniform(-0.015, 0.015, (2, 500))
    rise = 0.1e-3 * np.sin(2.0 * np.pi / 0.012 * (np.cos(0.5) * x + np.sin(0.5) * y))
    (before, before_x, before_y), (after, after_x, after_y) = (each.ground.relief(x, y) for each in (plain, waved))
    np.testing.assert_allclose(after - before, rise, atol=1e-12)
    step = 1e-7
    for slope, dx, dy in ((after_x - before_x, step, 0.0), (after_y - before_y, 0.0, step)):
        further = waved.ground.relief(x + dx, y + dy)[0] - plain.ground.relief(x + dx, y + dy)[0]
        np.testing.assert_allclose(slope, (further - rise) / step, atol=1e-4)
    px, py, pz = plain.seen.vertices.T
    shown = waved.seen.vertices[:, 2] - pz
    np.testing.assert_allclose(
        shown, 0.1e-3 * np.sin(2.0 * np.pi / 0.012 * (np.cos(0.5) * px + np.sin(0.5) * py)), atol=1e-12
    )
    assert Station.of(replace(STOCK.station, waviness=(0.0, 0.0, 0.0))).seen is plain.seen


def test_a_wave_comes_through_the_text_of_a_drawing() -> None:
    drawn = replace(STOCK, station=replace(STOCK.station, waviness=(0.1e-3, 0.012, 0.5)))
    assert read(drawn.as_json()).station.waviness == (0.1e-3, 0.012, 0.5)
    assert settled(drawn, STOCK).station.waviness == (0.1e-3, 0.012, 0.5)
    assert settled(STOCK, STOCK).station.waviness == (0.0, 0.0, 0.0)

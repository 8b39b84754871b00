"""A station's bodies: with a mesh of the part the part's own underside, without one the surface's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.bench.job.part_jobs import job_with_part
from sim_backends.world.bodies.station import Station
from sim_backends.world.bodies.surfaces import surface
from sim_backends.world.drawing import STOCK


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

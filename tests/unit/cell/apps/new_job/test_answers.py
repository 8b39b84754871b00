"""Promises of `cell.apps.new_job.answers`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.apps.new_job.answers import laid_mesh
from cell.apps.new_job.mesh_file import read_drawing
from cell.apps.new_job.questions import Asker


@pytest.mark.parametrize(("bodies", "sides"), [("all", (50.0, 30.0)), ("2", (10.0, 10.0))])
def test_several_bodies_are_told_and_those_that_are_named_are_the_surface(
    tmp_path: Path, bodies: str, sides: tuple[float, float]
) -> None:
    boxes = [trimesh.creation.box((40, 30, 10)), trimesh.creation.box((10, 10, 10)).apply_translation((25, 0, 0))]
    path = tmp_path / "two.stl"
    trimesh.util.concatenate(boxes).export(path)
    told: list[str] = []
    laid, _ = laid_mesh(Asker({"unit": "mm", "bodies": bodies}, None, told.append), read_drawing(path))
    assert any("2 bodies that share no corner" in text for text in told)
    assert 1e3 * np.ptp(laid.box, axis=0)[:2] == pytest.approx(sides)

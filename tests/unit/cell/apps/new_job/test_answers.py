"""Promises of `cell.apps.new_job.answers`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.apps.new_job.answers import laid_mesh
from cell.apps.new_job.mesh_file import read_drawing
from cell.apps.new_job.questions import Asker
from cell.apps.new_job.surface import open_side

OVER = {
    "side by side": (((40, 30, 10), (0, 0, 5)), ((10, 10, 10), (40, 0, 5)), False, 1300.0),
    "one on the other": (((40, 40, 10), (0, 0, 5)), ((20, 20, 10), (0, 0, 15)), False, 1600.0),
    "one in the other": (((40, 40, 20), (0, 0, 10)), ((20, 20, 10), (0, 0, 10)), True, 1600.0),
    "crossing": (((40, 30, 10), (0, 0, 5)), ((20, 20, 10), (15, 3, 9)), True, 1300.0),
    "tops in one plane": (((40, 30, 10), (0, 0, 5)), ((40, 20, 10), (25, 0, 5)), True, 1700.0),
}


@pytest.mark.parametrize("case", OVER)
def test_bodies_that_overlap_are_told_and_what_lies_double_counts_once(tmp_path: Path, case: str) -> None:
    *boxes, overlap, area = OVER[case]
    made = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes]
    path = tmp_path / "two.stl"
    trimesh.util.concatenate(made).export(path)
    told: list[str] = []
    laid, _ = laid_mesh(Asker({"unit": "mm"}, None, told.append), read_drawing(path))
    assert any("2 bodies that share no corner" in text for text in told)
    assert any("1 and 2 overlap" in text for text in told) is overlap
    corners = open_side(laid).vertices[open_side(laid).faces]
    seen = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].sum()
    assert 1e6 * seen == pytest.approx(area, rel=0.005)

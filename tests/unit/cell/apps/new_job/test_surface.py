"""Promises of `cell.apps.new_job.surface`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.apps.new_job.answers import laid_mesh
from cell.apps.new_job.mesh_file import read_drawing
from cell.apps.new_job.questions import Asker
from cell.apps.new_job.surface import lay, open_side


def test_only_what_lies_open_from_above_is_kept(tmp_path: Path) -> None:
    """A mushroom: its hat hides foot and stem. Seen from above is the square of its foot, no more and no less."""
    parts = [((60.0, 60.0, 4.0), 2.0), ((10.0, 10.0, 16.0), 12.0), ((30.0, 30.0, 4.0), 22.0)]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix((0, 0, z))) for size, z in parts]
    path = tmp_path / "mushroom.stl"
    trimesh.util.concatenate(boxes).export(path)
    seen = open_side(lay(read_drawing(path).bodies, "mm", "z", 0.0))
    corners = seen.vertices[seen.faces]
    areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    heights = corners[:, :, 2].mean(axis=1)
    assert (areas > 0).all()
    assert areas[heights > 0.020].sum() == pytest.approx(30e-3**2, rel=1e-6)
    assert areas[heights < 0.020].sum() == pytest.approx(60e-3**2 - 30e-3**2, rel=0.03)


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

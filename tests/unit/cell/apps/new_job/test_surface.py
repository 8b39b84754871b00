"""Promises of `cell.apps.new_job.surface`."""

import numpy as np
import pytest
import trimesh

from cell.apps.new_job.mesh_file import read_drawing
from cell.apps.new_job.surface import lay, open_side


def test_only_what_lies_open_from_above_is_kept(tmp_path):
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

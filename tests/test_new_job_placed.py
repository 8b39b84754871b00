"""A new part from its mesh to `placed`: what is proposed is what the job does, also where only tilted sweeps tell."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from cell import Cell
from cell.config import default_toml
from cell.job import load_job
from tests.test_described_jobs import require_placed
from tests.test_new_job import from_options


@pytest.mark.campaign
def test_a_bracket_of_flat_faces_is_placed_by_what_its_walls_tell(tmp_path: Path) -> None:
    parts = [((60.0, 50.0, 6.0), (0.0, 0.0, 3.0)), ((6.0, 50.0, 30.0), (-27.0, 0.0, 21.0)),
             ((20.0, 8.0, 10.0), (5.0, 10.0, 11.0))]  # fmt: skip
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    (tmp_path / "cell.toml").write_text(default_toml(), encoding="utf-8")
    mesh = tmp_path / "bracket.ply"
    trimesh.util.concatenate(boxes).export(mesh)
    made = from_options(tmp_path, mesh=str(mesh))
    assert any(swath.roll or swath.pitch for swath in load_job(made.job)[0].scan.swath)
    with Cell.open(tmp_path / "cell.toml", sim="all", clock="virtual", seed=1, job=made.job) as cell:
        report = cell.run(made.job).report
    require_placed(report)

"""A job whose placed part could not be seen is refused before anything moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.check.fit import require_fit
from cell.check.placed_part import verify_problems
from cell.check.reach import seen_faces
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.measure.inversion.nominal import read_mesh
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import body, job_with_part

CONFIG = load_config(None)


@pytest.mark.parametrize(
    ("verify", "flat", "told"),
    [
        ("all", False, None),
        ("all", True, r'pot-part\.ply": the faces of the placed part do not show .*x axis.*place\.verify = "seen"'),
        ("seen", True, None),
        ("none", True, None),
    ],
)
def test_motions_that_would_not_be_seen_are_told_unless_the_job_says_so(
    tmp_path: Path, verify: str, flat: bool, told: str | None
) -> None:
    job, mesh = load_job(job_with_part(tmp_path, "pot", verify=verify, flat=flat))
    if told is None:
        require_fit(job, CONFIG, mesh)
        return
    with pytest.raises(ConfigError, match=told):
        require_fit(job, CONFIG, mesh)


def test_a_part_too_high_for_the_picture_and_one_that_faces_down_are_told(tmp_path: Path) -> None:
    job, _ = load_job(job_with_part(tmp_path, "pot", verify="all"))
    low = job.model_copy(update={"scan": job.scan.model_copy(update={"stand_off": 0.06})})
    assert any("leaves the scan camera's picture" in told for told in verify_problems(low, CONFIG))
    assert job.part is not None
    sheet = tmp_path / "sheet.ply"
    trimesh.Trimesh(np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]]), [[0, 2, 1]]).export(sheet)
    down = job.model_copy(update={"part": job.part.model_copy(update={"mesh": str(sheet)})})
    assert [told for told in verify_problems(down, CONFIG) if "no face of part.mesh faces up" in told]


def test_nobody_looks_where_the_job_says_so_or_has_no_mesh(tmp_path: Path) -> None:
    job, _ = load_job(job_with_part(tmp_path, "pot", verify="none"))
    assert seen_faces(job) is None and list(verify_problems(job, CONFIG)) == []
    assert seen_faces(load_job("pot")[0]) is None


def test_the_sweep_over_the_placed_part_has_to_be_in_reach(tmp_path: Path) -> None:
    """A part of .9 m on a surface that is well in reach."""
    file = job_with_part(tmp_path, "pot", verify="all")
    vertices, faces = read_mesh(tmp_path / "pot.ply", "m")
    high = body(vertices, faces, lambda corners: corners)
    high.vertices[len(vertices) :, 2] += 0.9
    high.export(tmp_path / "pot-part.ply")
    job, mesh = load_job(file)
    with pytest.raises(ConfigError, match=r"sweep 1 \(the placed part\)"):
        require_fit(job, CONFIG, mesh)

"""Promises of `cell new-job` as a whole: the job fits the cell, and no file is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import load_job
from drivers.errors import ConfigError
from tests.unit.cell.apps.new_job.meshes import from_options, relief


def test_a_job_from_its_mesh_fits_the_cell_and_no_file_is_lost(tmp_path: Path) -> None:
    """In metres, wider than one sweep; written twice: only when that is said."""
    mesh = relief(
        tmp_path / "m.ply", lambda x, y: 8 + 3 * np.sin(x / 9 + 0.3) * np.cos(y / 11 - 0.5) + np.sin((x + 2 * y) / 16)
    )
    trimesh.load_mesh(mesh).apply_scale(1e-3).export(mesh)
    made = from_options(tmp_path, mesh=str(mesh), name="lid")
    assert (made.job.name, made.mesh.name, made.picture.name) == ("lid.toml", "lid.stl", "lid.png")
    job, surface = load_job(made.job)
    require_fit(job, load_config(None), surface, calibrates=True)
    assert len(job.scan.swath) == 2 and made.seen > 0.97
    written = made.job.read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match=r"there already.*--overwrite"):
        from_options(tmp_path, mesh=str(mesh), name="lid", part_size="20 mm, 20 mm, 20 mm")
    assert made.job.read_text(encoding="utf-8") == written

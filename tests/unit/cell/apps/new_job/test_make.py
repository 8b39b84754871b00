"""Promises of `cell new-job` as a whole: the job fits the cell, and no file is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.measure.geometry.poses import transform
from cell.measure.inversion.nominal import read_mesh
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import body
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


def test_the_mesh_of_the_part_goes_beside_the_job_and_has_to_fit_its_surface(tmp_path: Path) -> None:
    mesh = relief(
        tmp_path / "m.ply", lambda x, y: 8 + 3 * np.sin(x / 9 + 0.3) * np.cos(y / 11 - 0.5) + np.sin((x + 2 * y) / 16),
        half=14.0,
    )  # fmt: skip
    job, surface = load_job(from_options(tmp_path, mesh=str(mesh), name="lid", like="shell").job)
    assert job.part is None and job.place.accept is None, "that of `shell` is another part"
    vertices, faces = read_mesh(surface, "mm")
    lies = job.place.surface_from_part.se3().inverse()
    (tmp_path / "drawings").mkdir()
    for name, off in (("lid", 0.0), ("other", 1e-3)):
        moved = transform(lies, vertices) - [0.0, 0.0, off]
        body(moved, faces, lambda corners: corners).export(tmp_path / "drawings" / f"{name}.ply")
    given = {"mesh": str(mesh), "name": "lid", "part_unit": "m"}
    with pytest.raises(ConfigError, match=r"(?s)the part as drawn goes 1\.0.*Nothing was written"):
        from_options(tmp_path, True, part=str(tmp_path / "drawings" / "other.ply"), **given)
    made = from_options(tmp_path, True, part=str(tmp_path / "drawings" / "lid.ply"), **given)
    assert '[part]\nmesh = "lid-part.ply"' in made.job.read_text(encoding="utf-8")
    job, surface = load_job(made.job)
    assert job.part is not None and job.part.mesh == str(tmp_path / "lid-part.ply")
    require_fit(job, load_config(None), surface, calibrates=True)
    assert job.place.verify == "all"
    # A flat cover does not show how it lies along itself: the rest of it is looked at.
    body(transform(lies, vertices), faces, flat=True).export(tmp_path / "drawings" / "cover.ply")
    cover = from_options(tmp_path, True, **{**given, "name": "cover", "part": str(tmp_path / "drawings" / "cover.ply")})
    assert load_job(cover.job)[0].place.verify == "seen"
    with pytest.raises(ConfigError, match=r"lid-part\.ply: there already"):
        from_options(tmp_path, part=str(tmp_path / "drawings" / "lid.ply"), **given)
    with pytest.raises(ConfigError, match=r"--part: .*none\.ply cannot be read as a mesh"):
        from_options(tmp_path, True, part=str(tmp_path / "none.ply"), **given)

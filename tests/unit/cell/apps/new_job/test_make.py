"""`cell new-job`: what is wrong with a mesh is named, what the sweeps would not tell is said, files are not lost."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from cell.apps.new_job.make import Made, make_job
from cell.apps.new_job.mesh_file import read_drawing
from cell.apps.new_job.questions import Asker
from cell.apps.new_job.text import told_by_size
from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import load_job
from drivers.errors import ConfigError, NotObservable, RefusedError

Array = NDArray[np.float64]


def from_options(folder: Path, overwrite: bool = False, **given: str) -> Made:
    """As with --yes: the options given, the rest by its defaults."""
    options = {name.replace("_", "-"): text for name, text in given.items()}
    return make_job(Asker(options, None, lambda _: None), load_config(None), folder, overwrite)


def relief(path: Path, height: object, half: float = 25.0) -> Path:
    """A mesh of z = height(x, y), mm, over a square."""
    side = np.linspace(-half, half, 61)
    x, y = np.meshgrid(side, side, indexing="ij")
    k = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (corner.ravel() for corner in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    assert callable(height)
    trimesh.Trimesh(np.stack([x, y, height(x, y)], -1).reshape(-1, 3), faces).export(path)
    return path


def dish(path: Path, facets: int) -> Path:
    """A surface of revolution about z, its circles drawn with so many facets."""
    r, turn = np.meshgrid(np.linspace(1.0, 14.0, 25), np.linspace(0.0, 2 * np.pi, facets + 1), indexing="ij")
    corners = np.stack([r * np.cos(turn), r * np.sin(turn), 6.0 + 3.0 * np.cos(r / 4.0)], -1)
    k = np.arange(r.size).reshape(r.shape)
    a, b, c, d = (corner.ravel() for corner in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    trimesh.Trimesh(corners.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])).export(
        path
    )
    return path


def test_what_is_wrong_with_a_mesh_is_named_and_put_right(tmp_path: Path) -> None:
    inside_out, turned, lone = (trimesh.creation.box((20.0, 10.0, 5.0)) for _ in range(3))
    inside_out.invert()
    faces = turned.faces.copy()
    faces[3] = faces[3][::-1]
    turned = trimesh.Trimesh(turned.vertices + np.array([40.0, 0.0, 0.0]), faces, process=False)
    lone = trimesh.Trimesh(lone.vertices + np.array([80.0, 0.0, 0.0]), lone.faces[1:], process=False)
    flat = trimesh.Trimesh(np.array([[0, 0, 9], [1, 0, 9], [2, 0, 9]], dtype=float), [[0, 1, 2]], process=False)
    path = tmp_path / "parts.stl"
    trimesh.util.concatenate([inside_out, turned, lone, flat]).export(path)
    drawn = read_drawing(path)
    assert len(drawn.bodies) == 3 and drawn.unit is None
    assert sorted(body.closed for body in drawn.bodies) == [False, True, True]
    told = "\n".join(drawn.notes)
    for words in (
        "1 triangles without an area",
        "12 triangles turned round",
        "\n1 triangles turned round",
        "open: 3 edges",
    ):
        assert words in told, told
    for body in drawn.bodies:
        if body.closed:
            made = trimesh.Trimesh(body.vertices, body.triangles, process=False)
            assert made.volume == pytest.approx(1000.0)


@pytest.mark.parametrize("longest", [16.0, 600.0, 0.001])
def test_a_unit_that_the_size_does_not_tell_is_asked_for(longest: float) -> None:
    with pytest.raises(ConfigError, match="--unit"):
        told_by_size(longest)


def test_a_disc_is_refused_by_its_free_turn_however_coarsely_it_is_drawn(tmp_path: Path) -> None:
    """Facets of the drawing are no relief of the part."""
    with pytest.raises(NotObservable, match="rotation about the z axis") as refused:
        from_options(tmp_path, mesh=str(dish(tmp_path / "dish.stl", 12)))
    assert "--prior-angle" in str(refused.value) and "flat tops do not" in str(refused.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dish-refused.png", "dish.stl"]


def test_a_surface_that_repeats_itself_is_refused_by_its_pitch(tmp_path: Path) -> None:
    pattern = relief(tmp_path / "p.stl", lambda x, y: 6 + np.cos(2 * np.pi * x / 6) + np.cos(2 * np.pi * y / 6))
    with pytest.raises(RefusedError, match=r"looks the same elsewhere: shifted by .*6\.0") as refused:
        from_options(tmp_path, mesh=str(pattern))
    assert re.search(r'--prior "0\.(89|9) mm" or less', str(refused.value))


def test_what_takes_long_is_told_while_it_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cell.apps.new_job.questions.PROGRESS_S", 0.0)
    told: list[str] = []
    mesh = str(relief(tmp_path / "wave.stl", lambda x, y: 6 + 2 * np.sin(x / 6)))
    with pytest.raises(NotObservable):
        make_job(Asker({"mesh": mesh}, None, told.append), load_config(None), tmp_path, False)
    for words in ("triangles to look at …", "straight sweeps see …", "tilted sweep 8 of 8", "tells most", "other side"):
        assert any(words in text for text in told), told


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

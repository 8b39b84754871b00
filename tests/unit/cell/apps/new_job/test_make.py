"""Promises of `cell new-job` as a whole: the job fits the cell, and no file is lost."""

import re

import cv2
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cell.apps.new_job.make import COLOURS, _PartFile, _with_part, draw_proposal
from cell.apps.new_job.proposal import Proposal
from cell.apps.new_job.questions import Asker
from cell.apps.new_job.surface import Laid
from cell.apps.new_job.sweeps import Rays, visible_surfaces
from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import PartSection, SwathSection, load_job
from cell.measure.geometry.poses import transform
from cell.measure.inversion.nominal import read_mesh
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import body
from tests.support.report_runs import CONFIG, pot
from tests.unit.cell.apps.new_job.meshes import from_options, relief


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 8 + 3 * np.sin(x / 9 + 0.3) * np.cos(y / 11 - 0.5) + np.sin((x + 2 * y) / 16)


def test_a_job_from_its_mesh_fits_the_cell_and_no_file_is_lost(tmp_path):
    """In metres, wider than one sweep; written twice: only when that is said."""
    mesh = relief(tmp_path / "m.ply", waves)
    trimesh.load_mesh(mesh).apply_scale(1e-3).export(mesh)
    made = from_options(tmp_path, mesh=str(mesh), name="lid")
    assert (made.job.name, made.mesh.name, made.picture.name) == ("lid.toml", "lid.stl", "lid.png")
    assert made.picture.is_file()
    job, surface = load_job(made.job)
    require_fit(job, load_config(None), surface, calibrates=True)
    assert len(job.scan.swath) == 2 and made.seen > 0.97
    written = made.job.read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match=r"there already.*--overwrite"):
        from_options(tmp_path, mesh=str(mesh), name="lid", part_size="20 mm, 20 mm, 20 mm")
    assert made.job.read_text(encoding="utf-8") == written
    part = relief(tmp_path / "lid.stl", waves)
    with pytest.raises(ConfigError, match=r"lid\.stl is a mesh that was given, and would be overwritten"):
        from_options(tmp_path, True, mesh=str(mesh), name="lid", part=str(part), part_unit="mm")


def test_the_mesh_of_the_part_goes_beside_the_job_and_has_to_fit_its_surface(tmp_path, monkeypatch):
    monkeypatch.setattr("cell.apps.new_job.make.draw_proposal", lambda *_: None)  # takes longest
    mesh = relief(tmp_path / "m.ply", waves, half=14.0)
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
    cover = tmp_path / "drawings" / "cover.ply"
    body(transform(lies, vertices), faces, flat=True).export(cover)
    part = _PartFile(cover, cover, PartSection(mesh=str(cover), mesh_unit="m"))
    assert _with_part(Asker({}, None, lambda _: None), job, part).place.verify == "seen"
    with pytest.raises(ConfigError, match=r"lid-part\.ply: there already"):
        from_options(tmp_path, part=str(tmp_path / "drawings" / "lid.ply"), **given)
    with pytest.raises(ConfigError, match=r"--part: .*none\.ply cannot be read as a mesh"):
        from_options(tmp_path, True, part=str(tmp_path / "none.ply"), **given)


ACROSS = (-0.012, 0.016)


@pytest.fixture(scope="module")
def made() -> Proposal:
    """The middle of the pot in two sweeps side by side; much of it is left out."""
    job, nominal = pot(length=0.036, swath=tuple(SwathSection(across=f"{1e3 * y} mm") for y in ACROSS))
    vertices, faces = nominal.vertices, nominal.triangles
    seen = visible_surfaces(CONFIG, job, Rays(vertices, faces))
    return Proposal(job, Laid(vertices, faces, pin.SE3.Identity()), tuple(seen))


@pytest.fixture(scope="module")
def drawn(made: Proposal, tmp_path_factory) -> tuple[Figure, np.ndarray]:
    """The figure as it was written, and the pixels of its file."""
    kept: list[Figure] = []
    save = Figure.savefig
    path = tmp_path_factory.mktemp("picture") / "pot.png"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda figure, path: (kept.append(figure), save(figure, path)))
        draw_proposal(path, made, pot()[1], CONFIG, "job pot, as proposed")
    pixels = cv2.imread(str(path))
    return kept[0], pixels


def lines(axes: Axes, colour: str) -> list[np.ndarray]:
    """Corners (n, 2) of every line of this colour."""
    found = [np.asarray(line.get_xydata()) for line in axes.get_lines() if line.get_color() == colour]
    return [corners for corners in found if len(corners)]


def test_the_sweeps_are_drawn_where_the_proposal_has_them(made: Proposal, drawn: tuple[Figure, np.ndarray]):
    figure, pixels = drawn
    assert pixels.shape == (990, 1620, 3)
    assert sum("the arm at the first sweep" in axes.get_title() for axes in figure.axes) == 2
    above, cut = figure.axes[0], next(axes for axes in figure.axes if axes.get_title().startswith("across"))
    for colour, across, seen in zip(COLOURS, ACROSS, made.seen, strict=False):
        points = 1e3 * seen.points[seen.valid]
        (outline,) = lines(above, colour)
        assert outline.min(axis=0) == pytest.approx(points[:, :2].min(axis=0))
        assert outline.max(axis=0) == pytest.approx(points[:, :2].max(axis=0))
        # A corner of the outline has its colour in the file as well.
        column, row = above.transData.transform(outline[0])
        near = pixels[int(990 - row) - 2 : int(990 - row) + 3, int(column) - 2 : int(column) + 3, ::-1] / 255.0
        assert np.abs(near - to_rgb(colour)).sum(axis=2).min() < 0.1
        # From the camera, which is straight above the middle of its sweep, to both ends of what it sees.
        eyes = [corners[0] for corners in lines(cut, colour) if len(corners) == 2]
        assert len(eyes) == 2
        for eye in eyes:
            assert eye == pytest.approx([1e3 * across, 1e3 * made.job.scan.stand_off], abs=0.5)
    assert [text.get_text() for text in cut.get_legend().get_texts()] == [
        "sweep 1: -12.0 mm across", "sweep 2: +16.0 mm across"
    ]  # fmt: skip
    assert f"camera {1e3 * made.job.scan.stand_off:.0f} mm above z = 0, 2 × 36 mm by the rail" in cut.get_title()


def test_what_no_sweep_sees_and_the_part_are_shown(made: Proposal, drawn: tuple[Figure, np.ndarray]):
    above = drawn[0].axes[0]
    said = re.search(r"(\d+) % of the surface is seen", above.get_title())
    assert 30 < int(said[1]) < 95
    assert int(said[1]) == pytest.approx(100 * made.share, abs=2.0)
    hidden = np.asarray(above.collections[1].get_offsets())
    seen = 1e3 * np.concatenate([each.points[each.valid] for each in made.seen])[:, :2]
    inside = (np.abs(hidden[:, None] - seen[None, ::50]).max(axis=2) < 0.2).any(axis=1)
    assert inside.mean() < 0.02
    (part,) = [patch for patch in above.patches if isinstance(patch, Rectangle)]
    size, place = 1e3 * np.array(made.job.grasp.size), 1e3 * made.job.place.surface_from_part.se3().translation
    assert (part.get_width(), part.get_height()) == pytest.approx(tuple(size[:2]))
    assert part.get_center() == pytest.approx(place[:2])

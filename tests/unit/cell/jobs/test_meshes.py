"""The meshes of the shipped jobs are small, and a part is placed on them where the closed form has it."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.config.job import load_job
from cell.measure.inversion import NominalSurface, Tolerance
from cell.measure.inversion.mating import drawn_gap
from cell.measure.inversion.part_pose import seen_from_above, shown_by
from sim_backends.world.bodies.surfaces import surface
from tests.support.job_meshes import FOLDER, TRIANGLES

POINTS = 400_000


def test_all_meshes_together_take_no_more_than_300_kb():
    meshes = [path for path in FOLDER.iterdir() if path.suffix != ".toml"]
    assert sorted(path.stem for path in meshes) == sorted([*TRIANGLES, "facets", "shell-part"])
    assert sum(path.stat().st_size for path in meshes) <= 300_000


def test_the_part_that_ships_fits_its_surface_and_shows_how_it_lies():
    job, mesh = load_job("shell")
    part, belongs = NominalSurface.load(Path(job.part.mesh)), job.place.surface_from_part.se3()
    gap = drawn_gap(NominalSurface.load(mesh), belongs, part)
    assert gap is not None and np.abs(gap.gaps).max() < 1e-6 and gap.seen == 1.0
    assert shown_by(seen_from_above(part, belongs), Tolerance(job.place.tolerance, job.place.tolerance_angle)) == ()
    assert trimesh.load_mesh(job.part.mesh).is_watertight


@pytest.mark.parametrize("name", TRIANGLES)
def test_a_mesh_lies_on_its_closed_form(name: str):
    field = surface(name)
    half = np.array([field.half_x, field.half_y])
    mesh = trimesh.load_mesh(FOLDER / f"{name}.ply")
    seen_from_above = 0.5 * np.cross(*np.moveaxis(np.diff(mesh.triangles, axis=1), 1, 0))[:, 2]
    # Nothing folds, and nothing of the footprint is missing: not its corners either.
    assert seen_from_above.min() > 0.0
    assert mesh.extents[:2] == pytest.approx(2 * half, rel=1e-6)
    assert seen_from_above.sum() == pytest.approx(4 * half.prod(), rel=1e-6)

    points, _ = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
    heights, normals = field.sample(*np.clip(points[:, :2], -half, half).T)
    off = (points[:, 2] - heights) * normals[:, 2]
    assert np.sqrt(np.mean(off**2)) < 1.7e-6 and np.abs(off).max() < 15e-6
    # What a registration of the whole surface follows: its facets lie as much above the closed form as below.
    ways = np.hstack([normals, np.cross(points, normals)])
    pose, *_ = np.linalg.lstsq(ways, off, rcond=None)
    assert np.abs(pose[:3]).max() < 0.1e-6 and np.abs(pose[3:]).max() < 4e-6
    # Edges are as steep as the closed form has them.
    drawn, facets = np.degrees(np.arccos([normals[:, 2].min(), mesh.face_normals[:, 2].min()]))
    assert facets > drawn - 1.0

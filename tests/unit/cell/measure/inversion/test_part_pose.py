"""Which motions of a part its faces show, and what of it a sweep sees; where it lies is tested at `verify`."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from cell.config.job import load_job
from cell.measure.inversion import NominalSurface, Tolerance
from cell.measure.inversion.nominal import read_mesh
from cell.measure.inversion.part_pose import seen_from_above, shown_by
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import HEIGHT, body

HERE = pin.SE3.Identity()
TOLERANCE = Tolerance(0.6e-3, 6e-3)
JOB, MESH = load_job("pot")


def part(*, flat: bool = False) -> NominalSurface:
    made = body(*read_mesh(MESH, "m"), flat=flat)
    return NominalSurface(made.vertices, made.faces)


def of(mesh: trimesh.Trimesh) -> NominalSurface:
    return NominalSurface(mesh.vertices, mesh.faces)


def test_what_faces_up_is_seen_and_nothing_else() -> None:
    faces = seen_from_above(part(), HERE)
    low, high = faces.extent
    assert low[2] > HEIGHT - 0.01 and high[2] < HEIGHT + 0.012
    over = seen_from_above(part(), pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0), np.zeros(3)))
    assert over.samples[:, 2].max() < HEIGHT, "turned over, its underside is seen"
    below = NominalSurface(faces.vertices, faces.triangles[:, ::-1])
    with pytest.raises(ConfigError, match=r"no face of part\.mesh faces up"):
        seen_from_above(below, HERE)


@pytest.mark.parametrize(
    ("made", "unseen"),
    [
        (part(), ()),
        (part(flat=True), ("translation along the x", "translation along the y", "rotation about the z")),
        # A cone shows all but its turn about its own axis.
        (of(trimesh.creation.cone(0.02, 0.02, sections=1000)), ("rotation about the z",)),
    ],
    ids=["shell", "flat", "cone"],
)
def test_the_motions_that_the_faces_do_not_show_are_named(made: NominalSurface, unseen: tuple[str, ...]) -> None:
    found = shown_by(seen_from_above(made, HERE), TOLERANCE)
    assert len(found) == len(unseen)
    assert all(any(name.startswith(one) and name.endswith("part frame") for name in found) for one in unseen)

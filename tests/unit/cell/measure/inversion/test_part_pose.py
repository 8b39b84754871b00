"""Which motions of a part its faces show, and what of it a sweep sees; where it lies is tested at `verify`."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from numpy.typing import NDArray

from cell.config.job import load_job
from cell.measure.inversion import NominalSurface, Prior, Tolerance
from cell.measure.inversion.nominal import read_mesh
from cell.measure.inversion.part_pose import PartPose, find_part, seen_from_above, shown_by
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import HEIGHT, body
from tests.unit.cell.measure.inversion.test_registration import BOARD, TRUE, freeform, nominal, scanned

Array = NDArray[np.float64]
HERE = pin.SE3.Identity()
SWEPT = Prior(TRUE, BOARD)
TOLERANCE = Tolerance(0.6e-3, 6e-3)
JOB, MESH = load_job("pot")


@cache
def part(kind: str) -> NominalSurface:
    if kind == "cone":
        made = trimesh.creation.cone(0.02, 0.02, sections=400)
    else:
        made = body(*read_mesh(MESH, "m"), flat=kind == "flat")
    return NominalSurface(made.vertices, made.faces)


def test_what_faces_up_is_seen_and_nothing_else():
    faces = seen_from_above(part("shell"), HERE)
    low, high = faces.extent
    assert low[2] > HEIGHT - 0.01 and high[2] < HEIGHT + 0.012
    over = seen_from_above(part("shell"), pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0), np.zeros(3)))
    assert over.samples[:, 2].max() < HEIGHT, "turned over, its underside is seen"
    below = NominalSurface(faces.vertices, faces.triangles[:, ::-1])
    with pytest.raises(ConfigError, match=r"no face of part\.mesh faces up"):
        seen_from_above(below, HERE)


@pytest.mark.parametrize(
    ("kind", "unseen"),
    [
        ("shell", ()),
        ("flat", ("translation along the x", "translation along the y", "rotation about the z")),
        ("cone", ("rotation about the z",)),
    ],
)
def test_the_motions_that_the_faces_do_not_show_are_named(kind: str, unseen: tuple[str, ...]):
    found = shown_by(seen_from_above(part(kind), HERE), TOLERANCE)
    assert len(found) == len(unseen)
    assert all(any(name.startswith(one) and name.endswith("part frame") for name in found) for one in unseen)


def shell(x: Array, y: Array) -> Array:
    return 0.010 + freeform(x, y)


def nothing(points: Array) -> Array:
    return np.zeros((len(points), 3, 1))


def found(moved: Callable[[Array], Array], before: Prior = SWEPT) -> PartPose:
    """A part 30 mm long on the middle of a surface, which was found at `before` when it was swept first; `moved` tells
    how points (n, 3) m, arm base, are displaced."""
    cloud = scanned(lambda x, y: np.where(np.abs(x) < 0.015, shell(x, y), freeform(x, y)), 6)
    return find_part(
        cloud, nominal(shell, 0.015), nominal(freeform), surface=before,
        belongs=before.base_from_surface.inverse() * TRUE, tolerance=TOLERANCE,
        moved=lambda lines, rows: moved(cloud.points[lines, rows]), times=np.linspace(0.0, 5.0, cloud.shape[0]),
        base_from_vehicle=HERE,
    )  # fmt: skip


def test_what_moves_part_and_surface_alike_leaves_nothing_open_and_what_moves_one_does():
    def alike(points: Array) -> Array:
        """Six motions of a rigid body, .2 mm, and .5 mrad about the arm's foot, 0.75 m away."""
        turned = 0.5e-3 * np.cross(np.eye(3)[None], points[:, None]).transpose(0, 2, 1)
        return np.concatenate([np.broadcast_to(0.2e-3 * np.eye(3), (len(points), 3, 3)), turned], axis=2)

    def apart(points: Array) -> Array:
        high = ((points - TRUE.translation) @ TRUE.rotation)[:, 2] > 0.0135
        return 0.2e-3 * high[:, None, None] * TRUE.rotation[:, :1]

    looked = [found(moved) for moved in (nothing, alike, apart)]
    sure, same, own = (np.sqrt(np.diag(one.covariance)) for one in looked)
    assert sure[:3].max() < 0.02e-3 and np.allclose(same, sure, rtol=0.2)
    assert own[0] == pytest.approx(0.2e-3, rel=0.15)
    seen = looked[1]
    assert np.abs(seen.surface_from_part.translation).max() < 0.04e-3 and seen.beside > 1000
    assert np.linalg.norm(seen.base_from_surface.translation - TRUE.translation) < 0.04e-3


@pytest.mark.parametrize("slid", [0.0, 4e-3, 12e-3])
def test_a_surface_that_slid_under_the_part_is_found_where_it_is(slid: float):
    there = TRUE * pin.SE3(np.eye(3), np.array([0.0, slid, 0.0]))
    seen = found(nothing, Prior(there, 0.01 * BOARD))
    assert np.linalg.norm(seen.surface_from_part.translation) < 0.1e-3 and (seen.moved is None) == (slid == 0.0)
    if seen.moved is not None:
        assert np.linalg.norm(seen.moved[:3]) == pytest.approx(slid, rel=0.05)

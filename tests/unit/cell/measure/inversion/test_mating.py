"""The gap below a part as drawn: against rays, in the scan of a simulated cell, and what does not fit is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from numpy.typing import NDArray

from cell.config.job import load_job
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.mating import MatingGap, drawn_gap, scanned_gap
from cell.measure.inversion.nominal import read_mesh
from drivers.errors import RefusedError
from lab.bench.job.part_jobs import body
from lab.bench.job.whole_job import JobRecord

Floats = NDArray[np.float64]
HERE = pin.SE3.Identity()
TOLERANCE = 0.6e-3


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> pin.SE3:
    return pin.SE3(np.eye(3), np.array([x, y, z]))


def stepped(corners: Floats) -> Floats:
    """Half a millimetre lower on one side."""
    return np.asarray(corners - np.where(corners[:, :1] > 0.01, [0.0, 0.0, 0.5e-3], 0.0))


def drawn(name: str) -> tuple[NominalSurface, trimesh.Trimesh]:
    job, mesh = load_job(name)
    return NominalSurface.load(mesh, unit=job.surface.mesh_unit), body(*read_mesh(mesh, "m"))


def surface_of(part: trimesh.Trimesh) -> NominalSurface:
    return NominalSurface(part.vertices, part.faces)


POT, BODY = drawn("pot")


@cache
def part() -> NominalSurface:
    return surface_of(BODY)


@pytest.mark.parametrize("name", ["pot", "seat", "panel"])
def test_a_part_of_the_same_drawing_lies_on_the_surface(name: str):
    nominal, above = drawn(name)
    found = drawn_gap(nominal, HERE, surface_of(above))
    assert np.abs(found.gaps).max() < 1e-6 and found.seen > 0.95
    assert found.problem(TOLERANCE) is None and found.notes == ()


def test_the_gap_is_what_a_ray_measures():
    """A part that is shifted and turned: rays from the surface along the part's z axis meet it so far off."""
    lies = pin.SE3(pin.rpy.rpyToMatrix(0.004, -0.003, 0.01), np.array([0.4e-3, -0.2e-3, 0.3e-3]))
    found = drawn_gap(POT, lies, part())
    inner = np.linalg.norm(found.places[:, :2] / [0.030, 0.015], axis=1) < 1.0
    places, gaps = found.places[inner], found.gaps[inner]
    below = (places - lies.translation) @ lies.rotation
    # From well below, so that no ray begins inside the part.
    starts = below - [0.0, 0.0, 0.004]
    hits, rays, _ = BODY.ray.intersects_location(starts, np.tile([0.0, 0.0, 1.0], (len(starts), 1)))
    first = np.full(len(starts), np.inf)
    np.minimum.at(first, rays, hits[:, 2] - below[rays, 2])
    assert len(gaps) > 300 and np.isfinite(first).all()
    # By the nearest point, not along the ray: on this surface they differ by less than this.
    assert np.abs(gaps - first).max() < 0.01e-3


@pytest.mark.parametrize(
    ("height", "told"),
    [(-0.5e-3, r"goes 0\.50 mm into the surface at .*Allowed are 0\.30 mm.*datum"), (0.5e-3, r"lies 0\.50 mm or more")],
)
def test_a_mesh_in_another_datum_is_refused_with_how_much_and_what_to_see_to(height: float, told: str):
    found = drawn_gap(POT, moved(z=height), part())
    with pytest.raises(RefusedError, match=told) as refused:
        found.require(TOLERANCE)
    (number,) = refused.value.numbers
    assert (number.most, number.value) == pytest.approx((0.3, -1e3 * height), abs=0.01)
    found.require(4 * abs(height))


def test_a_wrong_revision_is_refused_where_it_differs():
    other = surface_of(body(POT.vertices, POT.triangles, stepped))
    found = drawn_gap(POT, HERE, other)
    assert found.overlap == pytest.approx(0.5e-3, abs=2e-6)
    assert found.places[np.argmin(found.gaps), 0] > 0.009
    assert "goes 0.50 mm into the surface at (1" in str(found.problem(TOLERANCE))


def test_one_square_of_noise_is_no_overlap():
    gaps, noise = np.array([0.0, -0.5e-3]), np.array([1e-6, 0.3e-3])
    found = MatingGap(np.zeros((2, 3)), gaps, noise, 1.0, np.zeros((2, 3)))
    assert found.overlap == pytest.approx(0.2e-3)
    assert found.problem(TOLERANCE) is None
    assert replace(found, noise=1e-6 * np.ones(2)).problem(TOLERANCE) is not None


def test_what_is_off_contact_brings_a_part_back_that_goes_into_the_surface():
    off = pin.SE3(pin.exp3(np.array([0.002, -0.001, 0.003])), np.array([0.2e-3, -0.15e-3, -0.05e-3]))
    found = drawn_gap(POT, off, part())
    assert found is not None and 0.05e-3 < found.interference < found.overlap
    motion = found.off_contact(off.translation, np.array([2e-3] * 3 + [20e-3] * 3))
    assert motion == pytest.approx([0.2e-3, -0.15e-3, -0.05e-3, 0.002, -0.001, 0.003], rel=0.03, abs=5e-6)
    deep = np.where(np.arange(len(found.gaps)) == 0, -0.5e-3, 0.0)
    assert replace(found, gaps=deep, noise=0.0 * deep).interference == 0.0, "one square may be dirt"
    rough = replace(found, gaps=np.random.default_rng(1).normal(0.0, 25e-6, 2000), noise=np.full(2000, 100e-6))
    assert abs(rough.interference) < 5e-6, "noise alone"


def test_the_scanned_surface_tells_the_same(placed_pot: JobRecord):
    cloud, pose = placed_pot.results["reconstruct"].cloud, placed_pot.results["invert_pose"].base_from_surface
    fits = scanned_gap(cloud, pose, POT, HERE, part())
    assert fits is not None and max(fits.overlap, np.abs(np.median(fits.gaps))) < 0.03e-3
    assert fits.seen > 0.75 and fits.problem(TOLERANCE) is None
    for height in (-0.5e-3, 0.5e-3):
        found = scanned_gap(cloud, pose, POT, moved(z=height), part())
        assert np.median(found.gaps) == pytest.approx(height, abs=0.03e-3)
        assert found.problem(TOLERANCE) is not None
    half = replace(cloud, points=np.where(np.arange(cloud.shape[0])[:, None, None] < 30, cloud.points, np.nan))
    less = scanned_gap(half, pose, POT, HERE, part())
    assert less is not None and less.seen < 0.5
    assert "lie over what was scanned" in less.notes[0] and "scan.length" in less.notes[0]


def test_a_part_that_lies_elsewhere_has_nothing_below_it():
    assert drawn_gap(POT, moved(x=0.2), part()) is None


def test_figures_are_for_people_and_for_the_journal():
    found = MatingGap(np.zeros((3, 3)), np.array([-0.12e-3, 0.0, 0.3e-3]), np.zeros(3), 0.87, np.zeros((3, 3)))
    assert found.words == "gap -0.12 to 0.30 mm, 0.00 mm in the middle; 87 % of it seen"
    assert found.as_dict() == {"least_mm": -0.12, "median_mm": 0.0, "largest_mm": 0.3, "seen": 0.87}

"""Flush along the edge of a placed part, against closed forms; that of a part in the world is tested at `verify`."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.flush import BESIDE_M, Flush, flush_along_edge
from cell.measure.inversion.part_pose import parted
from cell.measure.reconstruction.cloud import Cloud
from tests.unit.cell.measure.inversion.test_registration import TRUE, scanned

Array = NDArray[np.float64]
HALF, THICK, TOLERANCE = 0.020, 0.010, 0.6e-3
BELONGS = from_parts((0.0, 0.0, THICK))


def plate(half_x: float, half_y: float = 0.018) -> NominalSurface:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [half_x, half_y, 0.0]
    return NominalSurface(corners, [[0, 1, 2], [0, 2, 3]])


SURFACE, TOP = plate(0.035), plate(HALF)


def swept(part: Array | float, beside: Array | float = 0.0, thick: float = THICK) -> Cloud:
    """A part on the middle of a plate; each is higher than drawn by a number, or (offset, slope along y)."""

    def height(x: Array, y: Array) -> Array:
        own, other = (np.polyval(np.atleast_1d(lift)[::-1], y) for lift in (part, beside))
        return np.where(np.abs(x) < HALF, thick + own, other)

    return scanned(height, 5)


def looked(
    cloud: Cloud, pose: pin.SE3 = TRUE, *, surface: NominalSurface = SURFACE, faces: NominalSurface = TOP,
    belongs: pin.SE3 = BELONGS, lies: pin.SE3 | None = None, tolerance: float = TOLERANCE, rocks: float = 0.0,
) -> Flush | None:  # fmt: skip
    part, beside = parted(cloud, faces, pose * belongs)
    return flush_along_edge(
        part, beside, pose, nominal=surface, faces=faces, belongs=belongs, lies=lies or belongs, tolerance=tolerance,
        rocks=rocks,
    )  # fmt: skip


def test_a_part_that_stands_as_drawn_is_flush_within_its_noise():
    found = looked(swept(0.0))
    assert (np.abs(found.higher) < found.noise).all() and np.median(found.noise) < 0.15e-3
    assert found.beyond < 0.0
    # Both ends have some of the surface beside them; the sides have none, and the middle is no edge.
    x = np.abs(found.places[:, 0])
    assert x.min() > 0.013 and x.max() < HALF and len(found.higher) > 40
    assert HALF - x.min() < BESIDE_M


def test_each_piece_is_held_against_what_lies_beside_it():
    """The part is bent, 5 µm a mm along its edge; the surface is .1 mm lower beside it."""
    found = looked(swept(np.array([0.2e-3, 5e-3]), -0.1e-3))
    assert np.allclose(found.higher, 0.3e-3 + 5e-3 * found.places[:, 1], atol=0.05e-3)
    worst = np.abs(found.higher) - found.noise
    assert found.beyond == pytest.approx(1e3 * worst.max())
    assert found.as_dict() == {
        "least_mm": pytest.approx(0.22, abs=0.03), "median_mm": pytest.approx(0.3, abs=0.03),
        "largest_mm": pytest.approx(0.38, abs=0.03), "seen": 1.0,
    }  # fmt: skip
    assert re.fullmatch(r"\+0\.2\d to \+0\.[34]\d", found.span)


def test_where_the_sweep_shows_both_moved_alike_nothing_is_seen_of_it():
    """The arm's rest moves part and surface, so the surface is found beside its pose."""
    moved = TRUE * from_parts((0.1e-3, -0.2e-3, 0.3e-3))
    found = looked(swept(0.0), moved)
    assert np.abs(found.higher).max() < 0.06e-3


def test_without_the_surface_beside_the_part_there_is_no_flush():
    cloud = swept(0.0)
    assert looked(cloud, TRUE * from_parts((0.0, 0.0, 0.05))) is None
    assert looked(cloud, surface=plate(0.25 * HALF)) is None, "nothing of the surface shows"
    assert looked(cloud, faces=plate(0.2 * HALF), belongs=from_parts((0.0, 0.0, THICK))) is None, "only the part shows"


@pytest.mark.parametrize("thick", [1e-3, 2.8e-3])
def test_a_thin_part_is_not_held_against_itself(thick: float):
    found = looked(swept(0.0, thick=thick), belongs=from_parts((0.0, 0.0, thick)))
    assert np.abs(found.higher).max() < 0.06e-3 and found.seen == 1.0


def in_surface(cloud: Cloud) -> Array:
    """The points (lines, rows, 3) in the surface's frame, to be changed there and put back by `with_local`."""
    return (cloud.points - TRUE.translation) @ TRUE.rotation


def with_local(cloud: Cloud, local: Array) -> Cloud:
    return replace(cloud, points=local @ TRUE.rotation.T + TRUE.translation)


@pytest.mark.parametrize("lifted", [0.8e-3, 3.2e-3])
def test_a_corner_that_is_bent_far_up_is_seen(lifted: float):
    cloud = swept(0.0)
    local = in_surface(cloud)
    corner = (local[..., 0] > 0.014) & (local[..., 0] < HALF) & (local[..., 1] > 0.008)
    local[corner, 2] += lifted
    found = looked(with_local(cloud, local))
    assert found.beyond == pytest.approx(1e3 * lifted, abs=0.15)


def test_a_part_moved_to_the_side_is_no_higher_on_its_slopes():
    """A roof of 45 deg, .5 mm aside and .2 mm up, tilted about x: as a rigid body it is that much higher."""
    turn = pin.rpy.rpyToMatrix(0.0, -np.pi / 4, 0.0)
    flat = plate(HALF * np.sqrt(2.0))
    roof = NominalSurface(flat.vertices @ turn.T, flat.triangles)
    lies = BELONGS * from_parts((0.5e-3, 0.0, 0.2e-3), pin.exp3(np.array([2e-3, 0.0, 0.0])))

    def height(x: Array, y: Array) -> Array:
        there = lies.translation
        normal = lies.rotation @ [-np.sqrt(0.5), 0.0, np.sqrt(0.5)]
        z = there[2] - (normal[0] * (x - there[0]) + normal[1] * (y - there[1])) / normal[2]
        return np.where(np.abs(x) < HALF, z, 0.0)

    found = looked(scanned(height, 5), faces=roof, lies=lies)
    assert np.allclose(found.higher, 0.2e-3 + 2e-3 * found.places[:, 1], atol=0.06e-3)


def test_a_part_that_belongs_tilted_is_as_high_along_the_surface_s_z_axis():
    tilt = pin.rpy.rpyToMatrix(0.0, -0.4, 0.0)
    belongs = pin.SE3(tilt, np.array([0.0, 0.0, THICK]))

    def height(x: Array, y: Array) -> Array:
        return np.where(np.abs(x) < HALF, THICK + np.tan(0.4) * x + 0.4e-3, 0.0 * y)

    found = looked(scanned(height, 5), faces=plate(HALF / np.cos(0.4)), belongs=belongs)
    assert np.median(found.higher) == pytest.approx(0.4e-3, abs=0.01e-3)


def test_what_is_noisier_than_half_the_tolerance_says_nothing():
    found = looked(swept(0.0))
    middle = float(np.median(found.noise))
    fewer = looked(swept(0.0), tolerance=2.0 * middle)
    assert fewer.noise.max() <= middle and fewer.seen == pytest.approx(0.5, abs=0.02)
    assert found.notes == () and "say how flush it is" in replace(found, seen=0.4).notes[0]
    assert looked(swept(0.0), tolerance=1e-6) is None


def test_a_vehicle_that_rocks_may_have_a_piece_up_and_what_is_beside_it_down():
    still, rocked = looked(swept(0.0)), looked(swept(0.0), rocks=0.05e-3)
    assert rocked.noise.min() == pytest.approx(still.noise.min() + 0.1e-3)


def test_a_piece_whose_points_disagree_says_nothing():
    cloud = swept(0.0)
    local = in_surface(cloud)
    torn = (local[..., 0] > 0.012) & (np.abs(local[..., 0]) < HALF) & (np.abs(local[..., 1]) < 0.005)
    local[torn, 2] += np.random.default_rng(3).uniform(-2e-3, 2e-3, int(torn.sum()))
    found = looked(with_local(cloud, local))
    assert found.beyond < 0.0 and np.abs(found.higher).max() < 0.1e-3
    assert not ((found.places[:, 0] > 0.013) & (np.abs(found.places[:, 1]) < 0.004)).any()


def test_the_side_of_a_part_below_its_sloped_top_is_no_piece_of_that():
    """Its points lie at the rim; their feet on the top, which rises towards it, lie well inside."""
    thick, slope = 0.004, np.tan(0.3)
    belongs = pin.SE3(pin.rpy.rpyToMatrix(0.0, -0.3, 0.0), np.array([0.0, 0.0, thick]))
    cloud = scanned(lambda x, y: np.where(np.abs(x) < HALF, thick + slope * x, 0.0 * y), 5)
    local = in_surface(cloud)
    side = (local[..., 0] > HALF - 2e-3) & (local[..., 0] < HALF)
    local[side, 0] = HALF - 0.1e-3
    local[side, 2] = thick + slope * HALF - np.random.default_rng(4).uniform(3.5e-3, 3.6e-3, int(side.sum()))
    found = looked(with_local(cloud, local), faces=plate(HALF / np.cos(0.3)), belongs=belongs)
    assert found.beyond < 0.0 and np.abs(found.higher).max() < 0.1e-3

"""What is gone of a placed part's face, or covered, in scans whose truth is known; in the world: `verify`."""

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.whole_face import FacePatch, unlike_patch
from cell.measure.reconstruction.cloud import Cloud
from tests.unit.cell.measure.inversion.test_flush import BELONGS, HALF, THICK, TOP, in_surface
from tests.unit.cell.measure.inversion.test_local_deviation import HOLE, PIN, pierced, pinned, without
from tests.unit.cell.measure.inversion.test_registration import TRUE, scanned

Array = NDArray[np.float64]


def part(x: Array, y: Array) -> Array:
    """A plate 10 mm thick on the flat surface."""
    return np.where(np.abs(x) < HALF, THICK, 0.0 * y)


def corner(x: Array, y: Array) -> Array:
    """Of which a corner of 10 x 12 mm broke off."""
    return np.where((x > HALF - 10e-3) & (y > 6e-3), 0.0, part(x, y))


def nut(x: Array, y: Array) -> Array:
    """On which a nut of 8 mm lies."""
    return np.where(np.hypot(x + 5e-3, y + 4e-3) < 4e-3, THICK + 4e-3, part(x, y))


def looked(cloud: Cloud, faces: NominalSurface = TOP, lies: pin.SE3 = BELONGS) -> FacePatch | None:
    return unlike_patch(cloud, TRUE, lies, faces)


@pytest.mark.parametrize("seed", range(3))
def test_a_part_as_drawn_and_one_that_is_a_little_short_are_all_there(seed: int):
    for height, faces in ((part, TOP), (pierced, HOLE), (pinned, PIN)):
        assert looked(scanned(height, seed, outliers=0.05), faces) is None
    short = scanned(lambda x, y: np.where(x > HALF - 2.0e-3, 0.0, part(x, y)), seed)
    assert looked(short) is None, "its edge is asked by itself"


@pytest.mark.parametrize(
    ("height", "area", "at", "gone"),
    [(corner, 120.0, (HALF - 5e-3, 12e-3), True), (nut, np.pi * 16.0, (-5e-3, -4e-3), False)],
    ids=["corner", "nut"],
)
def test_what_is_gone_or_covered_is_told_with_its_size_and_place(
    height: Callable[[Array, Array], Array], area: float, at: tuple[float, float], gone: bool
):
    found = looked(scanned(height, 5))
    assert found is not None and found.gone is gone
    # Squares at a rim do not count.
    assert 0.4 * area < 1e6 * found.area < 1.05 * area
    assert np.hypot(*(found.at[:2] - at)) < 3e-3
    assert found.as_dict()["gone"] is gone and ("is not there" if gone else "stands on it") in found.words


def test_a_part_that_is_turned_and_shifted_is_told_in_its_own_frame():
    turn = pin.exp3(np.array([0.0, 0.0, 0.5 * np.pi]))
    lies = from_parts((2e-3, -1e-3, THICK), turn)
    there = lies.actInv(np.array([HALF - 5e-3 + 2e-3, 12e-3 - 1e-3, THICK]))
    cloud = scanned(lambda x, y: corner(x - 2e-3, y + 1e-3), 5)
    found = looked(cloud, NominalSurface(TOP.vertices @ turn, TOP.triangles), lies)
    assert found is not None and np.linalg.norm((found.at - there)[:2]) < 3e-3


@pytest.mark.parametrize("wide", [1.2e-3, 2.3e-3])
def test_a_slot_through_the_part_is_no_face_that_is_gone(wide: float):
    """Of which a sliver of a square is left to either side."""
    for k in range(0, 8, 2):
        left = 0.25e-3 * k + 0.1e-3
        right = left + wide
        x, y = [-HALF, left, right, HALF], [-0.018, -0.012, 0.012, 0.018]
        corners = np.array([[a, b, 0.0] for a in x for b in y])
        cells = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
        faces = [[4 * i + j, 4 * i + j + 4, 4 * i + j + 5] for i, j in cells]
        faces += [[4 * i + j, 4 * i + j + 5, 4 * i + j + 1] for i, j in cells]

        def slot(x: Array, y: Array, left: float = left, right: float = right) -> Array:
            return np.where((x > left) & (x < right) & (np.abs(y) < 0.012), 0.0, part(x, y))

        assert looked(scanned(slot, k), NominalSurface(corners, faces)) is None, left


def test_spots_far_apart_are_no_patch_and_the_largest_piece_tells_where():
    def spotted(x: Array, y: Array) -> Array:
        spots = [np.hypot(x - a, y - b) < 2.2e-3 for a in (-15e-3, 15e-3) for b in (-11e-3, 11e-3)]
        return np.where(np.any(spots, axis=0), THICK + 3e-3, part(x, y))

    assert looked(scanned(spotted, 5)) is None
    found = looked(scanned(lambda x, y: np.where(corner(x, y) > 0.0, spotted(x, y), 0.0), 5))
    assert found is not None and found.gone and np.hypot(*(found.at[:2] - (HALF - 5e-3, 12e-3))) < 3e-3


def test_long_thin_triangles_are_asked_as_closely_as_others():
    """A plate of 400 strips of its whole width, each two triangles."""
    x = np.linspace(-HALF, HALF, 401)
    corners = np.column_stack([np.tile(x, 2), np.repeat([-0.018, 0.018], 401), np.zeros(802)])
    strips = [[k, k + 1, 401 + k] for k in range(400)] + [[k + 1, 402 + k, 401 + k] for k in range(400)]
    found = looked(scanned(corner, 5), NominalSurface(corners, strips))
    assert found is not None and found.gone and 1e6 * found.area > 60.0


def test_what_the_sweep_does_not_show_is_not_told_as_gone():
    cloud = scanned(corner, 5)
    local = in_surface(cloud)
    assert looked(without(cloud, (local[..., 0] > HALF - 10e-3) & (local[..., 1] > 6e-3))) is None
    small = scanned(lambda x, y: np.where(np.hypot(x, y) < 2.2e-3, 0.0, part(x, y)), 5)
    assert looked(small) is None, "so little may be a reflection"

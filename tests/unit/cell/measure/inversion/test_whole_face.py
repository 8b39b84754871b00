"""What is gone of a placed part's face, or covered, in scans whose truth is known; in the world: `verify`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.whole_face import MOST_UNLIKE, FacePatch, unlike_patch
from cell.measure.reconstruction import Cloud
from tests.unit.cell.measure.inversion.test_flush import BELONGS, HALF, THICK, TOP
from tests.unit.cell.measure.inversion.test_local_deviation import HOLE, PIN, pierced, pinned
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


@pytest.mark.parametrize("seed", range(6))
def test_a_part_as_drawn_and_one_that_is_a_little_short_are_all_there(seed: int) -> None:
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
) -> None:
    found = looked(scanned(height, 5))
    assert found is not None and found.gone is gone
    # Squares at a rim do not count.
    assert 0.4 * area < 1e6 * found.area < 1.05 * area
    assert np.hypot(*(found.at[:2] - at)) < 3e-3
    assert found.as_dict()["gone"] is gone and ("is not there" if gone else "stands on it") in found.words


def test_a_part_that_is_turned_and_shifted_is_told_in_its_own_frame() -> None:
    turn = pin.exp3(np.array([0.0, 0.0, 0.5 * np.pi]))
    lies = from_parts((2e-3, -1e-3, THICK), turn)
    faces = NominalSurface(
        TOP.vertices @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T, TOP.triangles
    )
    there = lies.inverse() * pin.SE3(np.eye(3), np.array([HALF - 5e-3 + 2e-3, 12e-3 - 1e-3, THICK]))
    cloud = scanned(lambda x, y: corner(x - 2e-3, y + 1e-3), 5)
    found = looked(cloud, NominalSurface(TOP.vertices @ turn, TOP.triangles), lies)
    assert found is not None and np.linalg.norm((found.at - there.translation)[:2]) < 3e-3, faces


def test_what_the_sweep_does_not_show_is_not_told_as_gone() -> None:
    cloud = scanned(corner, 5)
    local = (cloud.points - TRUE.translation) @ TRUE.rotation
    dark = (local[..., 0] > HALF - 10e-3) & (local[..., 1] > 6e-3)
    assert looked(replace(cloud, points=np.where(dark[..., None], np.nan, cloud.points))) is None
    few = scanned(lambda x, y: np.where(np.hypot(x, y) < 2e-3, 0.0, part(x, y)), 5)
    found = looked(few)
    assert found is None or found.area > MOST_UNLIKE

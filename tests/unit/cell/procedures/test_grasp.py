"""What the parts of a batch have alike is told from what they have by chance."""

import numpy as np
import pinocchio as pin
import pytest

from cell.procedures.grasp import NEWEST, GraspSeries
from tests.support.lying_part import moved

POINTS = np.array([[x, y, 0.0] for x in (-0.02, 0.02) for y in (-0.015, 0.015)])
NOISE = 0.05e-3


def series(*aside: tuple[float, float, float]) -> GraspSeries:
    """Of parts that came to lie aside by these, mm and mrad, and were placed again with a slip of nothing."""
    made = GraspSeries()
    for x, y, turn in aside:
        made = made.after(moved(1e-3 * x, 1e-3 * y, turn=(0.0, 0.0, 1e-3 * turn)), [pin.SE3.Identity()])
    return made


def test_two_parts_that_came_alike_are_allowed_for_in_the_next():
    found = series((0.30, -0.10, 4.0), (0.34, -0.14, 5.0)).allowance(POINTS, NOISE)
    assert np.allclose(found.translation, [0.32e-3, -0.12e-3, 0.0])
    assert pin.log3(found.rotation)[2] == pytest.approx(4.5e-3)


def test_one_part_may_have_been_bumped():
    assert series((0.4, 0.0, 0.0)).allowance(POINTS, NOISE) is None
    assert series((0.0, 0.02, 0.0), (0.5, 0.0, 0.0)).allowance(POINTS, NOISE) is None
    assert series((0.30, 0.0, 0.0), (0.0, 0.9, 0.0), (0.32, 0.0, 0.0)).allowance(POINTS, NOISE) is None


def test_parts_that_lie_far_aside_are_for_a_person():
    assert series((1.9, 0.0, 0.0), (1.9, 0.0, 0.0)).allowance(POINTS, NOISE) is not None
    assert series((2.1, 0.0, 0.0), (2.1, 0.0, 0.0)).allowance(POINTS, NOISE) is None


@pytest.mark.parametrize("seed", range(20))
def test_what_the_arm_errs_by_is_not_allowed_for(seed: int):
    """Each way as much as brings the points off by the noise on average."""
    drawn = np.random.default_rng(seed).normal(size=(6, 3)) * [0.04, 0.04, 0.0]
    assert series(*map(tuple, drawn.tolist())).allowance(POINTS, NOISE) is None


def test_the_newest_parts_count():
    """A finger that was mended brings the parts back to the middle."""
    worn = [(0.4, 0.0, 0.0)] * NEWEST
    found = series(*worn, *[(0.0, 0.01, 0.0)] * NEWEST)
    assert found.aside.shape == (NEWEST, 3) and found.allowance(POINTS, NOISE) is None


def test_how_a_part_slips_is_known_from_those_that_were_placed_again():
    assert series((0.4, 0.0, 0.0), (0.4, 0.0, 0.0)).slip(POINTS, NOISE) == pin.SE3.Identity()
    slips = [moved(0.5e-3), moved(0.46e-3)]
    assert GraspSeries().after(moved(0.48e-3), slips[:1]).slip(POINTS, NOISE) is None
    found = GraspSeries().after(moved(0.48e-3), slips).slip(POINTS, NOISE)
    assert found is not None and found.translation[0] == pytest.approx(0.48e-3)

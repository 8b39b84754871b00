"""Small versions of the campaigns behind `cell paper`: on their bounds, reproducible, and outliers found."""

import numpy as np
import pinocchio as pin
import pytest

from cell.measure.geometry.poses import from_parts
from lab.bench.over_cores import over_cores
from lab.paper import rig
from lab.paper.rig import RigSpec, Sweep, dot_centres, draw_head
from lab.paper.table1 import SPEC, one_seed, spoil
from sim_backends.optics import Board


@pytest.fixture(scope="module")
def run():
    return one_seed(3)


def test_a_calibrated_head_measures_as_well_as_its_covariance_says(run):
    assert 0.9 < run["chi2_per_dof"] < 1.1
    points = run["points"]["1000"]
    # One head's mean error is one draw: it lies within a few times its expectation.
    assert 0.2 * run["bound_scan_frame"] < points["joint"]["mean"] < 2.5 * run["bound_scan_frame"]
    assert points["joint"]["aligned_mean"] < 0.04
    assert points["nominal"]["mean"] > 10 * points["joint"]["mean"]
    assert 0.4 * run["bound_arm_base"] < run["table"]["joint"]["d"]["mean"] < 2 * run["bound_arm_base"]
    assert run["table"]["joint"]["d"]["max"] < 0.3


def test_table_rows_are_possible(run):
    # The printed Table 1 is not: its largest D is more than its largest X, Y and Z together.
    for table in run["table"].values():
        together = np.sqrt(sum(table[axis]["max"] ** 2 for axis in "xyz"))
        assert table["d"]["max"] <= together + 1e-12


def test_outliers_of_every_kind_are_found(run):
    assert run["outliers"]["recall"] >= 0.99 and run["outliers"]["precision"] >= 0.90
    assert run["outliers"]["recall_near"] >= 0.99


def test_outliers_are_put_in_at_the_share_asked_for():
    centres = np.full((60, 480), 300.0)
    sweep = Sweep(centres, np.zeros(60), np.zeros((60, 480, 3)))
    spoiled = spoil(sweep, SPEC, 0.03, np.random.default_rng(0))
    assert spoiled.any.sum() == round(0.03 * centres.size)
    assert sum(int(mask.sum()) for mask in spoiled.kinds.values()) == spoiled.any.sum()
    assert (spoiled.centres[~spoiled.any] == 300.0).all()
    # 0.3 mm of depth are more than a pixel here.
    assert np.abs(spoiled.centres[spoiled.any] - 300.0).min() > 1.0


def test_centres_of_dots_are_those_of_their_conics():
    head = draw_head(RigSpec(), np.random.default_rng(0), "ideal")
    board = Board.parse("marked_dots:11x9:3mm")
    rotation = pin.exp3(np.array([0.5, -0.3, 0.2]))
    pose = from_parts(np.array([-0.01, -0.01, 0.13]), rotation)
    # The dual of the circle's image, C* = H diag(r², r², −1)* Hᵀ: its last column is the centre.
    k = np.array([[head.optics.fx, 0, head.optics.cx], [0, head.optics.fy, head.optics.cy], [0, 0, 1.0]])
    expected = []
    for centre in board.points:
        h = k @ np.column_stack([rotation[:, 0], rotation[:, 1], rotation @ centre + pose.translation])
        dual = h @ np.diag([board.dot_radius**2, board.dot_radius**2, -1.0]) @ h.T
        expected.append(dual[:2, 2] / dual[2, 2])
    assert np.abs(dot_centres(head.optics, pose, board) - expected).max() < 2e-4


def test_expected_length_of_a_round_error_is_that_of_maxwell():
    sigma = 2e-5
    found = rig.expected_length(np.tile(sigma**2 * np.eye(3), (5, 1, 1)))
    assert found == pytest.approx(sigma * np.sqrt(8 / np.pi), rel=1e-9)
    # Along one axis alone it is the mean absolute value of a normal variable; in a plane, Rayleigh's mean.
    line, plane = np.diag([0.0, sigma**2, 0.0])[None], np.diag([sigma**2, 0.0, sigma**2])[None]
    assert rig.expected_length(line) == pytest.approx(sigma * np.sqrt(2 / np.pi), rel=2e-3)
    assert rig.expected_length(plane) == pytest.approx(sigma * np.sqrt(np.pi / 2), rel=2e-3)


def test_alignment_takes_out_a_rigid_motion_and_nothing_else():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(200, 3))
    moved = points @ pin.exp3(np.array([0.1, 0.2, -0.3])).T + [1.0, 2.0, 3.0]
    assert np.abs(rig.aligned(moved, points)).max() < 1e-12
    assert np.linalg.norm(rig.aligned(1.01 * points, points), axis=1).mean() == pytest.approx(
        0.01 * np.linalg.norm(points - points.mean(axis=0), axis=1).mean(), rel=1e-3
    )


def test_results_come_in_the_order_of_the_tasks_and_each_is_told():
    told: list[int] = []
    assert over_cores([(abs, -4), (pow, 3, 2)], 1, told.append) == [4, 9]
    assert sorted(told) == [4, 9]

"""The bench of the planner draws the same pairs again, and its least distance is that of a closed form."""

import numpy as np
import pytest

from cell.motion import collision
from cell.motion.collision import CollisionModel
from cell.motion.kinematics import ArmKinematics
from cell.motion.planning import Planner
from lab.bench.job.planner import PEERS, PRODUCT, free_posture, least_distance, planner


def test_each_planner_has_a_row_and_every_pair_with_a_way_is_joined(monkeypatch):
    monkeypatch.delitem(PEERS, "OMPL BIT*")
    result = planner("pot", 2, 1, 1.0, lambda text: None)
    rows = {row["planner"]: row for row in result["planners"]}
    assert list(rows) == [PRODUCT, *PEERS]
    assert result["with_a_way"] == 2 and result["within_limits"]
    assert rows[PRODUCT]["solved"] == 2 and rows[PRODUCT]["least_distance_mm"] >= 5.0


def test_the_least_distance_is_found_between_the_corners():
    arm = ArmKinematics()
    x, y, z = arm.fk(np.zeros(6)).translation
    ball = collision.capsule("ball", collision.FLANGE, (0.0, 0.0, 0.0), (0.0, 0.0, 1e-4), 0.05)
    reach = np.hypot(x, y)
    post = collision.capsule("post", collision.BASE, (reach + 0.2, 0.0, z - 1.0), (reach + 0.2, 0.0, z + 1.0), 0.02)
    joined = Planner(arm, CollisionModel(arm, [ball, post]))
    # The first joint takes the ball past the post: nearest in the middle of the way, 200 mm less both radii.
    way = np.zeros((2, 6))
    way[:, 0] = -np.arctan2(y, x) + np.array([-1.0, 1.0])
    assert joined.collisions.distances(way[0]).min() > 0.3
    assert least_distance(joined, way) == pytest.approx(0.13, abs=2e-4)


def test_postures_are_drawn_alike_and_are_free():
    arm = ArmKinematics()
    joined = Planner(arm, CollisionModel(arm, collision.arm_bodies()))
    first, again = (free_posture(joined, np.random.default_rng(4)) for _ in range(2))
    assert np.array_equal(first, again) and joined.collisions.free(first)
    assert np.all(np.abs(first) <= np.pi)

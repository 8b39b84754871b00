"""Promises of `drivers.arm.motion`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.arm.motion import JointTrajectory, pose_difference


def test_a_trajectory_is_straight_between_its_points_and_ends_at_its_last():
    trajectory = JointTrajectory([0.0, 1.0, 3.0], [(0.0,) * 6, (1.0,) * 6, (5.0,) * 6])
    assert trajectory.at(-1.0) == (0.0,) * 6
    assert trajectory.at(0.25) == pytest.approx((0.25,) * 6)
    assert trajectory.at(2.0) == pytest.approx((3.0,) * 6)
    assert trajectory.at(99.0) == (5.0,) * 6


def test_pose_difference_agrees_with_an_independent_one():
    generator = np.random.default_rng(1)
    for _ in range(50):
        a, b = generator.normal(size=(2, 6))
        way, turn = pose_difference(tuple(a), tuple(b))
        assert way == pytest.approx(np.linalg.norm(a[:3] - b[:3]))
        between = Rotation.from_rotvec(a[3:]).inv() * Rotation.from_rotvec(b[3:])
        assert turn == pytest.approx(between.magnitude(), abs=1e-6)


def test_a_trajectory_knows_its_speed_for_a_stop_on_the_way():
    trajectory = JointTrajectory([0.0, 1.0, 3.0], [(0.0,) * 6, (1.0,) * 6, (5.0, *(1.0,) * 5)])
    assert [trajectory.speed_at(time) for time in (-1.0, 0.5, 2.0, 3.0)] == [0.0, 1.0, 2.0, 0.0]

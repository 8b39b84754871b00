"""The way to the target: planar poses form a group, and the line law brings the vehicle in from beside the line."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cell.steps.approach import Planar, line_command, wrap


def test_planar_poses_are_a_group() -> None:
    a, b = Planar(1.0, -2.0, 0.7), Planar(-0.3, 0.4, 2.9)
    identity = a * a.inverse()
    assert (identity.x, identity.y, identity.yaw) == pytest.approx((0, 0, 0), abs=1e-12)
    left, right = (a * b).inverse(), b.inverse() * a.inverse()
    assert (left.x, left.y, left.yaw) == pytest.approx((right.x, right.y, right.yaw), abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 3.0, -3.0, 7.0, -7.0, 100.0])
def test_wrapped_angles_are_the_same_direction(angle: float) -> None:
    assert abs(wrap(angle)) <= math.pi
    assert math.cos(wrap(angle)) == pytest.approx(math.cos(angle))


@pytest.mark.parametrize("seed", range(20))
def test_the_line_law_arrives_within_a_centimetre_and_a_degree(seed: int) -> None:
    """A vehicle with limited acceleration, controlled at 25 Hz, from up to 40 mm and 2° beside an 0.8 m line."""
    rng = np.random.default_rng(seed)
    pose = Planar(-0.8, rng.uniform(-0.04, 0.04), math.radians(rng.uniform(-2, 2)))
    goal, speed, rate, command, step = Planar(0.0, 0.0, 0.0), 0.0, 0.0, (0.0, 0.0), 0.01
    for tick in range(3000):
        if tick % 4 == 0:
            command = line_command(pose, goal, 0.4)
            if command[0] <= 0:
                break
        speed += np.clip(command[0] - speed, -0.5 * step, 0.5 * step)
        rate += np.clip(command[1] - rate, -1.5 * step, 1.5 * step)
        pose = pose * Planar(speed * step, 0.0, rate * step)
    assert abs(pose.x) < 0.002
    assert abs(pose.y) < 0.010
    assert abs(pose.yaw) < math.radians(2.0)
    assert speed < 0.05


def test_backwards_the_law_steers_the_other_way() -> None:
    ahead = line_command(Planar(-0.5, 0.02, 0.0), Planar(0, 0, 0), 0.3)
    behind = line_command(Planar(0.5, 0.02, 0.0), Planar(0, 0, 0), 0.3)
    assert ahead[0] > 0 > behind[0]
    assert ahead[1] < 0 < behind[1]

"""Promises of `drivers.arm.motion`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.arm.motion import JointTrajectory, UrMotion, pose_difference
from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceFault, NotConnectedError


def test_a_trajectory_is_straight_between_its_points_and_ends_at_its_last():
    trajectory = JointTrajectory([0.0, 1.0, 3.0], [(0.0,) * 6, (1.0,) * 6, (5.0,) * 6])
    assert (trajectory.at(-1.0), trajectory.at(0.25)) == ((0.0,) * 6, pytest.approx((0.25,) * 6))
    assert (trajectory.at(2.0), trajectory.at(99.0)) == (pytest.approx((3.0,) * 6), (5.0,) * 6)


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


def motion(stops):
    return UrMotion("arm", "move", 1, Clock(), lambda: stops.append("stop"))


def test_a_motion_that_arrived_can_be_waited_for_twice():
    moving = motion([])
    assert not moving.done
    moving.end("arrived")
    moving.wait(0.0)
    moving.wait(0.0)
    assert moving.done and not moving.contact


def test_a_motion_that_ended_at_its_force_limit_says_so_without_an_error():
    moving = motion([])
    moving.end("contact")
    moving.wait(0.0)
    assert moving.contact


def test_a_motion_that_takes_too_long_is_stopped():
    stops = []
    with pytest.raises(DeadlineError, match=r"did not end within 0\.01 s and was stopped"):
        motion(stops).wait(0.01)
    assert stops == ["stop"]


def test_a_motion_whose_stop_fails_is_not_told_as_stopped():
    def failing():
        raise NotConnectedError("arm", "the link is gone")

    with pytest.raises(DeadlineError, match=r"the stop was not confirmed: .*the link is gone.*emergency stop"):
        UrMotion("arm", "move", 1, Clock(), failing).wait(0.01)


def test_a_stopped_or_failed_motion_never_returns():
    stopped, failed = motion([]), motion([])
    stopped.end("stopped")
    failed.end("arm.protective_stop")
    failed.end("arrived")
    with pytest.raises(Aborted):
        stopped.wait(1.0)
    with pytest.raises(DeviceFault) as caught:
        failed.wait(1.0)
    assert caught.value.code == "arm.protective_stop"

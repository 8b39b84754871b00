"""The motions of the simulated arm against closed forms."""

import numpy as np
import pinocchio as pin
import pytest

from sim_backends.models.arm import Safety
from sim_backends.models.arm_kinematics import UR10E_DH
from sim_backends.models.arm_motion import ForceMode, JointMove, LinearMove, Servo
from tests.support.simulator.simulated_arm import TICK, finish, make_arm, pinocchio_flange, run


def test_a_joint_move_takes_the_time_of_its_trapezoid_and_arrives_exactly():
    arm = make_arm()
    target = arm.drive.q + np.array([0.8, -0.2, 0.1, 0.0, 0.3, -0.4])
    arm.start(JointMove(target, 0.5, 1.0))
    assert finish(arm) == pytest.approx(0.8 / 0.5 + 0.5 / 1.0, abs=2 * TICK)
    np.testing.assert_array_equal(arm.drive.q, target)
    np.testing.assert_array_equal(arm.drive.qd, np.zeros(6))


def test_a_linear_move_keeps_to_the_line_at_its_speed():
    arm = make_arm()
    start = arm.reported_flange()
    target = start.copy()
    target[:3, 3] += [0.05, -0.1, 0.08]
    target[:3, :3] = pin.exp3(np.array([0.05, 0.0, 0.1])) @ target[:3, :3]
    arm.start(LinearMove(target, 0.1, 0.5))
    way = target[:3, 3] - start[:3, 3]
    points = []
    while not arm.idle:
        arm.tick(arm.time + TICK)
        points.append(arm.reported_flange()[:3, 3] - start[:3, 3])
    line = np.array(points)
    along = line @ way / np.linalg.norm(way)
    assert np.linalg.norm(line - np.outer(along, way) / np.linalg.norm(way), axis=1).max() < 1e-8
    assert np.diff(along).max() == pytest.approx(0.1 * TICK, rel=1e-4)
    np.testing.assert_allclose(arm.reported_flange(), target, atol=1e-8)


def test_a_servo_target_that_moves_evenly_is_followed_with_the_lag():
    arm = make_arm()
    start = arm.drive.q.copy()
    servo = Servo(start, lag=0.05)
    arm.start(servo)
    rate = np.array([0.2, -0.1, 0.1, 0, 0.3, 0])
    for k in range(1, 501):
        servo.target = start + rate * (k * TICK)
        arm.tick(arm.time + TICK)
    # Each target already holds for the tick that leads to it: half a tick less of lag.
    np.testing.assert_allclose(servo.target - arm.drive.q, rate * (0.05 - TICK / 2), atol=1e-6)
    run(arm, 1.0)
    np.testing.assert_allclose(arm.drive.q, servo.target, atol=1e-8)


def test_force_mode_settles_at_the_wanted_force():
    arm = make_arm()
    surface = arm.reported_flange()[2, 3] - 0.005
    arm.contact = lambda pose: np.array([0.0, 0, 1e5 * max(0.0, surface - pose[2, 3]), 0, 0, 0])
    down = np.array([0.0, 0, 1, 0, 0, 0])
    arm.start(ForceMode(np.eye(4), down, -20.0 * down, np.full(6, 0.05)))
    run(arm, 1.5, 0.008)
    assert arm.wrench[2] == pytest.approx(20.0, abs=0.5)
    assert np.abs(arm.reported_flange()[:2, 3] - pinocchio_flange(UR10E_DH, arm.params.initial_q)[:2, 3]).max() < 1e-5


def test_a_line_through_the_edge_of_the_reach_is_a_protective_stop():
    arm = make_arm()
    target = arm.reported_flange()
    target[0, 3] += 1.0
    arm.start(LinearMove(target, 0.5, 2.0))
    run(arm, 5.0)
    assert arm.safety is Safety.PROTECTIVE_STOP

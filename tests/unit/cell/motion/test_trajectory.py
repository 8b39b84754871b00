"""Motions keep to the limits of joints, lines and carried points, and rest at both ends."""

from itertools import product

import numpy as np
import pinocchio as pin
import pytest

from cell.motion import collision, trajectory
from cell.motion.kinematics import ArmKinematics, DenavitHartenberg, JointLimits, Unreachable
from drivers.errors import RefusedError
from tests.unit.cell.motion.conftest import DOWN, FLANGE_FROM_PART, WORKING, assert_within, down, independent_fk


def test_a_joint_move_is_jerk_limited_and_rests_at_both_ends():
    limits, start, end = JointLimits(), np.zeros(6), np.array([1.5, -1.0, 0.5, -2.0, 0.1, 0.0])
    motion = trajectory.plan_joint(start, end, limits, period=0.002)
    assert_within(motion, limits)
    assert np.array_equal(motion.start, start) and np.array_equal(motion.end, end)
    assert np.abs(motion.speeds()[[0, -1]]).max() < 1e-3


def test_a_move_to_where_the_arm_stands_is_a_motion_of_one_period():
    motion = trajectory.plan_joint(WORKING, WORKING, JointLimits())
    assert motion.duration > 0
    assert np.array_equal(motion.start, motion.end)


def test_a_joint_move_out_of_range_is_refused():
    with pytest.raises(RefusedError, match="outside the ranges"):
        trajectory.plan_joint(np.zeros(6), np.array([0, 0, 4.0, 0, 0, 0]), JointLimits())


def test_a_line_is_straight_and_turns_evenly(arm: ArmKinematics):
    start = arm.ik(down(0.70, -0.1, 0.35), WORKING)
    a = arm.fk(start)
    b = pin.SE3(DOWN @ pin.utils.rotate("z", 0.3), np.array([0.80, 0.10, 0.25]))
    motion = trajectory.plan_line(arm, start, b, trajectory.LineLimits(speed=0.2))
    way = b.translation - a.translation
    for joints in motion.joints[::5]:
        pose = independent_fk(joints)
        s = float((pose[:3, 3] - a.translation) @ way / (way @ way))
        assert np.linalg.norm(pose[:3, 3] - a.translation - s * way) < 1e-8
        assert np.linalg.norm(pin.log3(a.rotation.T @ pose[:3, :3])) == pytest.approx(0.3 * s, abs=1e-6)
    flange = np.array([independent_fk(q)[:3, 3] for q in motion.joints])
    assert np.linalg.norm(np.diff(flange, axis=0), axis=1).max() / 0.008 <= 0.2 * 1.001
    assert np.all(np.abs(motion.speeds()) <= np.array(arm.limits.speed))


@pytest.mark.parametrize("leaving", [False, True])
@pytest.mark.parametrize(("length", "fast"), [(0.05, True), (0.0055, False), (0.004, False)])
def test_near_its_place_a_line_is_slow_and_beyond_it_fast(arm: ArmKinematics, leaving: bool, length: float, fast: bool):
    start = arm.ik(down(0.70, -0.1, 0.35), WORKING)
    goal = arm.fk(start)
    goal.translation -= [0.0, 0.0, length]
    limits = trajectory.LineLimits(speed=0.25, acceleration=0.75, near=5e-3, near_speed=0.04, leaving=leaving)
    motion = trajectory.plan_line(arm, start, goal, limits)
    gone = np.array([float(arm.fk(start).translation[2] - independent_fk(q)[2, 3]) for q in motion.joints])
    speeds, middles = np.diff(gone) / np.diff(motion.times), 0.5 * (gone[1:] + gone[:-1])
    near = middles < 5e-3 if leaving else middles > length - 5e-3
    assert speeds[near].max() <= 0.04 * 1.02 and speeds.min() > 0.0
    assert gone[-1] == pytest.approx(length, abs=1e-6)
    # Even, also where it goes from one to the other: a step of the speed would be a jerk.
    assert np.abs(np.diff(speeds, n=2)).max() < 8.0 * 0.008**2 * 1.5
    assert (speeds.max() > 0.12) == fast


def test_a_line_through_a_singular_posture_is_refused(arm: ArmKinematics):
    start = np.array([0.0, -1.2, 1.8, -2.1, -0.3, 0.0])
    end = np.array([0.0, -1.2, 1.8, -2.1, 0.3, 0.0])
    with pytest.raises((trajectory.SingularLine, Unreachable)):
        trajectory.plan_line(arm, start, arm.fk(end))


def test_motions_join_only_where_they_meet():
    a = trajectory.plan_joint(np.zeros(6), np.full(6, 0.1), JointLimits())
    b = trajectory.plan_joint(np.full(6, 0.1), np.full(6, -0.1), JointLimits())
    both = trajectory.join([a, b])
    assert both.duration == pytest.approx(a.duration + b.duration)
    assert np.all(np.diff(both.times) > 0)
    with pytest.raises(ValueError, match="starts"):
        trajectory.join([b, b])


def corners_on_the_flange() -> np.ndarray:
    """Corners of claw, scan head, target camera and part, homogeneous (n, 4), from their sizes as the cell has them."""
    signs = np.array(list(product((-0.5, 0.5), repeat=3)))
    bodies = collision.tool_bodies((0.070, 0.036, 0.020), FLANGE_FROM_PART)
    corners = [signs * body.size @ body.placement.rotation.T + body.placement.translation for body in bodies]
    return np.pad(np.vstack([np.zeros((1, 3)), *corners]), ((0, 0), (0, 1)), constant_values=1.0)


def fastest_point(motion: trajectory.Trajectory, count: int) -> float:
    """Speed in m/s of the fastest corner, by differences over `count` steps of plain matrices: not as planned."""
    times, table = np.linspace(0.0, motion.duration, count), DenavitHartenberg()
    flanges = np.eye(4)
    for column, d, a, alpha in zip(motion.joints.T, table.d, table.a, table.alpha, strict=True):
        q = np.interp(times, motion.times, column)
        (c, s), ca, sa, one = (np.cos(q), np.sin(q)), np.cos(alpha), np.sin(alpha), np.ones(count)
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        flanges = flanges @ np.array([[one * value for value in row] for row in rows]).transpose(2, 0, 1)
    placed = (corners_on_the_flange() @ flanges.transpose(0, 2, 1))[:, :, :3]
    return float(np.linalg.norm(np.diff(placed, axis=0), axis=2).max() / (times[1] - times[0]))


def test_no_point_of_flange_tool_or_part_is_faster_than_allowed_in_free_moves(arm: ArmKinematics):
    generator = np.random.default_rng(9)
    solids = collision.tool_bodies((0.070, 0.036, 0.020), FLANGE_FROM_PART)
    limits = JointLimits(speed=(1.6,) * 6, acceleration=(3.0,) * 6, jerk=(20.0,) * 6)
    bound = trajectory.PointSpeed(arm, trajectory.carried_points(solids), 0.5)
    unbound, speeds = [], []
    for _ in range(25):
        start = WORKING + generator.uniform(-1.0, 1.0, 6)
        end = WORKING + generator.uniform(-1.0, 1.0, 6)
        unbound.append(fastest_point(trajectory.plan_joint(start, end, limits), 1000))
        motion = trajectory.plan_joint(start, end, limits, points=bound)
        speeds.append(fastest_point(motion, 1000))
        assert np.allclose(motion.end, end)
    assert max(unbound) > 1.0, "the moves would be too fast otherwise"
    assert max(speeds) <= 0.5
    assert np.median(speeds) > 0.47, "and are not slower than need be"

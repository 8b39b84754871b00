"""The simulated arm without its network: true poses, the force that it feels, its safety system."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams, Safety
from sim_backends.models.arm_kinematics import UR10E_DH, pose_error
from sim_backends.models.arm_motion import JointMove, JointSpeed, LinearSpeed, Servo
from tests.support.simulator.simulated_arm import TICK, finish, make_arm, pinocchio_flange, run

Array = NDArray[np.float64]


@pytest.mark.parametrize(
    ("name", "fastest"),
    [
        ("UR3e", (180, 180, 180, 360, 360, 360)), ("UR5e", (180, 180, 180, 180, 180, 180)),
        ("UR10e", (120, 120, 180, 180, 180, 180)), ("UR30", (120, 120, 150, 210, 210, 210)),
    ],
)  # fmt: skip
def test_each_models_joints_turn_as_fast_as_the_maker_says_and_no_faster(name: str, fastest: tuple[float, ...]):
    for joint, limit in enumerate(fastest):
        model = ArmModel(ArmParams.of(name), np.random.default_rng(3), WorldClock())
        # The others go as well, but not as far: the leading joint limits all.
        goal = model.drive.q + 0.1
        goal[joint] += 1.4
        model.start(JointMove(goal, 100.0, 1000.0))
        seen = 0.0
        for step in range(1, 1000):
            model.tick(0.002 * step)
            seen = max(seen, abs(float(model.drive.qd[joint])))
        assert math.degrees(seen) == pytest.approx(limit)
        assert model.safety is Safety.NORMAL and model.idle


def test_the_reported_pose_follows_the_nominal_table_and_the_true_pose_the_true_one():
    error = np.random.default_rng(5).normal(scale=3e-4, size=(6, 4))
    arm = make_arm(dh_error=error)
    arm.start(JointMove(arm.drive.q + 0.2, 1.0, 2.0))
    finish(arm)
    np.testing.assert_allclose(arm.reported_flange(), pinocchio_flange(UR10E_DH, arm.drive.q), atol=1e-12)
    true = pinocchio_flange(UR10E_DH + error, arm.drive.q)
    np.testing.assert_allclose(arm.base_from_flange(arm.time), true, atol=1e-12)


def test_each_rest_has_its_own_error_of_the_stated_size_and_keeps_it():
    arm = make_arm(repeatability=(30e-6, 20e-6))
    home, away = arm.drive.q.copy(), arm.drive.q + 0.1
    rests = []
    for _ in range(80):
        for target in (away, home):
            arm.start(JointMove(target, 2.0, 10.0))
            while not arm.idle:
                arm.tick(arm.time + 0.01)
            run(arm, 0.05, 0.01)
        first = arm.base_from_flange(arm.time)
        run(arm, 0.05, 0.01)
        np.testing.assert_array_equal(arm.base_from_flange(arm.time), first)
        rests.append(pose_error(first, pinocchio_flange(UR10E_DH, home)))
    spread = np.std(rests, axis=0)
    # 80 samples give a standard deviation to 8 %; nearly four of those for six axes.
    np.testing.assert_allclose(spread[:3], 30e-6, rtol=0.3)
    np.testing.assert_allclose(spread[3:], 20e-6, rtol=0.3)
    assert abs(np.corrcoef(np.array(rests)[:-1, 0], np.array(rests)[1:, 0])[0, 1]) < 0.3


def test_the_true_pose_never_jumps():
    arm = make_arm(repeatability=(50e-6, 0.0))
    arm.start(JointMove(arm.drive.q + np.array([0.1, 0, 0, 0, 0, 0]), 0.5, 1.0))
    last, jumps = arm.base_from_flange(arm.time), []
    while not arm.idle:
        arm.tick(arm.time + TICK)
        now = arm.base_from_flange(arm.time)
        nominal = arm.drive.qd[0] * math.hypot(*now[:2, 3])
        jumps.append(np.linalg.norm(now[:3, 3] - last[:3, 3]) - nominal * TICK)
        last = now
    # The error wanders over 0.3 s: at most a few standard deviations times pi/2 over 150 ticks, and half a tick's ramp.
    assert max(jumps) < 5 * 50e-6 * math.pi / 2 / 150 + 2e-6


def test_a_force_above_the_limit_stops_the_arm():
    arm = make_arm()
    surface = arm.reported_flange()[2, 3] - 0.02
    arm.contact = lambda pose: np.array([0.0, 0, 5e4 * max(0.0, surface - pose[2, 3]), 0, 0, 0])
    arm.start(LinearSpeed(np.array([0.0, 0.0, -0.02, 0, 0, 0]), 1.0))
    run(arm, 1.5)
    assert arm.safety is Safety.PROTECTIVE_STOP
    assert "150 N" in arm.fault_text
    assert not arm.moving
    assert surface - arm.reported_flange()[2, 3] == pytest.approx(150 / 5e4, abs=2e-4)


def test_the_wrench_can_be_taken_as_zero_and_carries_the_stated_noise():
    arm = make_arm(force_noise=(0.5, 0.05))
    arm.contact = lambda pose: np.array([1.0, 2.0, -30.0, 0.1, 0.2, 0.3])
    run(arm, 0.01)
    arm.zero_force()
    samples = []
    for _ in range(1000):
        arm.tick(arm.time + TICK)
        samples.append(arm.felt)
    np.testing.assert_allclose(np.mean(samples, axis=0), 0.0, atol=0.08)
    np.testing.assert_allclose(np.std(samples, axis=0), [0.5] * 3 + [0.05] * 3, rtol=0.12)


@pytest.mark.parametrize("way", [np.array([2.0, 0, 0, 0, 0, 0]), np.array([0, 0, 0, 0, 0, math.nan])])
def test_a_servo_target_that_cannot_be_followed_is_a_protective_stop(way: Array):
    arm = make_arm()
    arm.start(Servo(arm.drive.q + way, 0.02))
    run(arm, 0.5)
    assert arm.safety is Safety.PROTECTIVE_STOP
    assert "limit" in arm.fault_text
    assert np.isfinite(arm.drive.q).all()
    assert not arm.moving


def test_a_joint_beyond_its_range_is_a_protective_stop():
    arm = make_arm(initial_q=np.array([6.0, -1.5, -1.5, -1.5, 1.5, 0]))
    arm.start(JointSpeed(np.array([1.0, 0, 0, 0, 0, 0]), 5.0))
    run(arm, 1.0)
    assert arm.safety is Safety.PROTECTIVE_STOP
    assert "360°" in arm.fault_text
    assert arm.drive.q[0] <= 2 * math.pi


def test_a_protective_stop_can_be_unlocked_after_its_delay_and_the_motion_resumed():
    arm = make_arm()
    target = arm.drive.q + 0.5
    arm.start(JointMove(target, 0.5, 1.0))
    run(arm, 0.5)
    arm.fault("protective_stop")
    run(arm, 1.0)
    assert not arm.moving and not arm.ready and not arm.unlock()
    run(arm, 4.1)
    assert arm.unlock() and arm.ready
    run(arm, 0.5)
    assert not arm.moving, "an unlocked arm must not move by itself"
    arm.resume()
    finish(arm)
    np.testing.assert_array_equal(arm.drive.q, target)

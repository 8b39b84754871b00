"""Promises of `sim_backends.models.arm_kinematics`."""

import math

import numpy as np
import pinocchio as pin
import pytest

from sim_backends.models.arm_kinematics import UR10E_DH, JointErrors, Kinematics, TruePose, rotation_vector
from tests.support.simulator.simulated_arm import pinocchio_arm, pinocchio_flange


def test_rotation_vectors_agree_with_pinocchio_up_to_half_a_turn():
    rng = np.random.default_rng(4)
    axes = rng.normal(size=(40, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    for axis, angle in zip(axes, np.linspace(0.0, math.pi - 1e-9, 40), strict=True):
        np.testing.assert_allclose(rotation_vector(pin.exp3(axis * angle)), axis * angle, atol=1e-7)
    down = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(np.abs(rotation_vector(down)), math.pi / math.sqrt(2) * np.array([1, 1, 0]), atol=1e-12)


def test_a_stretched_arm_sags_about_its_shoulder():
    errors = JointErrors(Kinematics(UR10E_DH), np.zeros((6, 4)), compliance=3e-6, mass=2.0)
    flat = np.zeros(6)
    reach = np.linalg.norm(Kinematics(UR10E_DH).forward(flat)[:2, 3])
    turned = errors.true(flat) - flat
    assert abs(turned[1]) == pytest.approx(3e-6 * 2.0 * 9.81 * reach, rel=0.05)
    lowered = Kinematics(UR10E_DH).forward(errors.true(flat))[2, 3] - Kinematics(UR10E_DH).forward(flat)[2, 3]
    assert lowered < 0.0


def test_with_a_memory_the_error_changes_with_the_way_and_keeps_its_size():
    def run(step: float, rng: np.random.Generator) -> tuple[float, float]:
        made = TruePose(Kinematics(UR10E_DH), (1e-4, 0.0), 0.3, rng, memory=0.5)
        q = np.zeros(6)
        made.update(0.0, 0.1, q, moving=False)
        before = made.pose[:3, 3] - Kinematics(UR10E_DH).forward(q)[:3, 3]
        q = q + np.array([step, 0, 0, 0, 0, 0])
        made.update(0.1, 0.1, q, moving=True)
        after = made.pose[:3, 3] - Kinematics(UR10E_DH).forward(q)[:3, 3]
        return float(before @ after), float(after @ after)

    near = np.mean([run(0.01, np.random.default_rng(k)) for k in range(200)], axis=0)
    far = np.mean([run(3.0, np.random.default_rng(k)) for k in range(200)], axis=0)
    assert near[0] > 0.9 * 3e-8 * 0.9
    assert abs(far[0]) < 0.2 * 3e-8
    assert near[1] == pytest.approx(3e-8, rel=0.2)
    assert far[1] == pytest.approx(3e-8, rel=0.2)


def test_forward_kinematics_and_jacobian_agree_with_pinocchio():
    rng = np.random.default_rng(1)
    for _ in range(20):
        table = UR10E_DH + rng.normal(scale=1e-3, size=(6, 4))
        q = rng.uniform(-2 * math.pi, 2 * math.pi, 6)
        pose, jacobian = Kinematics(table).forward_with_jacobian(q)
        np.testing.assert_allclose(pose, pinocchio_flange(table, q), atol=1e-12)
        np.testing.assert_allclose(Kinematics(table).forward(q), pose, atol=1e-15)
        model = pinocchio_arm(table)
        data = model.createData()
        expected = pin.computeFrameJacobian(
            model, data, q, model.getFrameId("flange"), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        np.testing.assert_allclose(jacobian, expected, atol=1e-12)


def test_inverse_kinematics_reaches_the_pose_within_the_joint_limits():
    rng = np.random.default_rng(2)
    for _ in range(50):
        target = pinocchio_flange(UR10E_DH, rng.uniform(-3, 3, 6))
        q = Kinematics(UR10E_DH).inverse(target, rng.uniform(-3, 3, 6))
        assert q is not None
        assert np.abs(q).max() <= 2 * math.pi
        np.testing.assert_allclose(pinocchio_flange(UR10E_DH, q), target, atol=1e-8)

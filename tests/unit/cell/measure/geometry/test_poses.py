"""Poses in and out of other forms, their covariances, and the root that variants of a calibration are made with."""

import numpy as np
import pinocchio as pin
import pytest

from cell.measure.geometry import poses
from cell.measure.geometry.poses import covariance_root
from tests.unit.cell.measure.geometry.test_board_projection import numerical


def test_the_columns_make_the_covariance_whatever_the_units():
    rng = np.random.default_rng(2)
    # Pixels beside micrometres, strongly correlated, and one parameter that is known.
    units = np.array([1.0, 1e-2, 1e-4, 3e-6, 0.0, 2e-5])
    mixed = rng.normal(size=(6, 3)) @ rng.normal(size=(3, 6)) + 1e-2 * rng.normal(size=(6, 6))
    covariance = units[:, None] * (mixed @ mixed.T) * units
    root = covariance_root(covariance)
    assert root.shape == (6, 5)
    np.testing.assert_allclose((root @ root.T)[units > 0][:, units > 0], covariance[units > 0][:, units > 0], rtol=1e-9)
    assert not (root @ root.T)[4].any()
    assert covariance_root(np.zeros((3, 3))).shape == (3, 0)


def test_arm_vectors_and_quaternions_round_trip():
    vector = np.array([0.1, -0.4, 0.7, 1.2, -0.5, 2.0])
    np.testing.assert_allclose(poses.to_ur(poses.from_ur(vector)), vector, atol=1e-12)
    half = np.sqrt(0.5)
    turn = poses.from_quaternion([1, 2, 3], [0, 0, half, half])
    np.testing.assert_allclose(poses.transform(turn, [1.0, 0.0, 0.0]), [1, 3, 3], atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.1, 1.0, 1.0, 1.0]), np.eye(3), np.eye(4) + np.diag([0.1], -3)],
    ids=["a mirror", "a scale", "no translation", "a wrong last row"],
)
def test_what_is_no_rotation_and_translation_is_no_pose(wrong):
    with pytest.raises(ValueError, match=r"rotation|last row"):
        poses.from_matrix(wrong)


@pytest.mark.parametrize("wrong", [(0.0, 0.0, 0.0, 1.1), (0.0, 0.0, 0.0, 0.9), (0.0, 0.0, 1.0)])
def test_a_quaternion_of_another_length_is_no_rotation(wrong):
    with pytest.raises(ValueError, match="quaternion"):
        poses.from_quaternion((0.0, 0.0, 0.0), wrong)


def test_cross_products_are_numpys():
    a, b = np.random.default_rng(1).normal(size=(2, 5, 3))
    np.testing.assert_allclose(poses.cross(a, b), np.cross(a, b), atol=1e-15)


def test_covariances_travel_as_the_finite_differences_of_the_poses_say():
    a_from_b, b_from_c = pin.SE3.Random(), pin.SE3.Random()
    first, second = (mix @ mix.T for mix in np.random.default_rng(7).normal(size=(2, 6, 6)))
    nominal, still = a_from_b * b_from_c, np.zeros(6)
    by_first = numerical(lambda d: poses.difference(poses.perturbed(a_from_b, d) * b_from_c, nominal), still)
    by_second = numerical(lambda d: poses.difference(a_from_b * poses.perturbed(b_from_c, d), nominal), still)
    expected = by_first @ first @ by_first.T + by_second @ second @ by_second.T
    np.testing.assert_allclose(poses.compose_covariance(a_from_b, first, b_from_c, second), expected, atol=1e-6)

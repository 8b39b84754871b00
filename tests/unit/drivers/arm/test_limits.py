"""Promises of `drivers.arm.limits`."""

import numpy as np
import pytest

from drivers.arm.limits import ArmLimits
from drivers.errors import LimitError

LIMITS = ArmLimits()


REST = np.array([0.0, -1.5, -1.5, -1.5, 1.5, 0.0])


def test_angles_inside_the_limits_pass_and_others_are_named_with_value_range_and_unit():
    assert LIMITS.check_joints("arm", REST) is not None
    with pytest.raises(LimitError, match=r"angle of joint 3 400 deg is outside -360 deg to 360 deg"):
        LIMITS.check_joints("arm", np.radians([0, 0, 400, 0, 0, 0]))


@pytest.mark.parametrize("joints", [np.zeros(5), np.full(6, np.nan), np.zeros((2, 6))])
def test_anything_but_six_finite_angles_is_refused(joints):
    with pytest.raises(LimitError, match="6 finite numbers"):
        LIMITS.check_joints("arm", joints)


@pytest.mark.parametrize("axis", range(3))
def test_a_pose_out_of_reach_is_refused(axis):
    flange = np.zeros(6)
    flange[axis] = -2.0
    with pytest.raises(LimitError, match=r"distance of the flange from the base 2000 mm is outside 0 mm to 1450 mm"):
        LIMITS.check_pose("arm", flange)


@pytest.mark.parametrize(
    ("check", "speed", "acceleration", "message"),
    [
        (LIMITS.check_joint_move, 0.0, 1.0, "joint speed 0 deg/s"),
        (LIMITS.check_joint_move, -1.0, 1.0, "joint speed"),
        (LIMITS.check_joint_move, 4.0, 1.0, "to 180 deg/s"),
        (LIMITS.check_joint_move, 1.0, 9.0, "acceleration"),
        (LIMITS.check_linear_move, 0.0, 1.0, "flange speed 0 mm/s"),
        (LIMITS.check_linear_move, 1.1, 1.0, "to 1000 mm/s"),
        (LIMITS.check_linear_move, 0.1, 5.1, "flange acceleration 5100 mm"),
        (LIMITS.check_linear_move, 0.1, -1.0, "flange acc"),
    ],
)
def test_speeds_and_accelerations_have_limits_and_those_of_straight_moves_their_own(
    check, speed, acceleration, message
):
    LIMITS.check_linear_move("arm", 1.0, 5.0)
    with pytest.raises(LimitError, match=message):
        check("arm", speed, acceleration)


def test_a_payload_too_heavy_is_refused():
    with pytest.raises(LimitError, match=r"payload 13 kg is outside 0 kg to 12\.5 kg"):
        LIMITS.check_payload("arm", 13.0, np.zeros(3))
    with pytest.raises(LimitError, match="3 numbers in m, not"):
        LIMITS.check_payload("arm", 1.0, np.zeros(2))


@pytest.mark.parametrize("axis", range(3))
def test_a_centre_of_gravity_in_millimetres_is_refused(axis):
    with pytest.raises(LimitError, match="payload offset"):
        LIMITS.check_payload("arm", 1.0, np.eye(3)[axis] * -60.0)


@pytest.mark.parametrize(
    ("times", "joints", "message"),
    [
        ([0.0], [REST], "at least 2"),
        ([0.0, 1.0], [REST[:5], REST[:5]], "at least 2"),
        ([0.1, 1.0], [REST, REST], "begin at 0 s"),
        ([0.0, 1.0, 1.0], [REST, REST, REST], "increase"),
        ([0.0, np.inf], [REST, REST], "not finite"),
        ([0.0, 1.0], [REST, np.where(np.arange(6) == 2, np.nan, REST)], "not finite"),
        ([0.0, 9.0, 8.0], [REST, REST, REST], "increase"),
        ([0.0, 1.0], [REST, REST + 8], "angle of joint 1 on the trajectory"),
        ([0.0, 9.0], [REST, REST - 6.5], "angle of joint 1 on the trajectory"),
        (
            [0.0, 0.01],
            [REST, REST + np.array([0, 0.1, 0, 0, 0, 0])],
            r"joint 2 would turn at 572\.958 deg/s at 0\.000 s",
        ),
        # Joint 6 turns faster, and may.
        ([0.0, 1.0], [REST, REST + np.array([0, -2.2, 0, 0, 0, 3.0])], r"joint 2 would turn at 126\.051 deg/s"),
    ],
)
def test_a_trajectory_that_cannot_be_driven_is_refused(times, joints, message):
    with pytest.raises(LimitError, match=message):
        LIMITS.check_trajectory("arm", np.array(times), np.array(joints))

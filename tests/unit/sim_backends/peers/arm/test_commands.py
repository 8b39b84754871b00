"""The commands of the control script, given by the real ur_rtde."""

import numpy as np
import pinocchio as pin
import pytest
from rtde_control import Path as MovePath
from rtde_control import PathEntry, RTDEControlInterface

from tests.support.simulator.ur_client import HOME, Client, distance, flange, se3, until

pytestmark = pytest.mark.wire


def test_moves_to_a_pose_and_along_a_line_to_joints(arm: Client):
    goal = flange(HOME + 0.1)
    pose = [*goal.translation, *pin.log3(goal.rotation)]
    assert arm.control.moveJ_IK(pose, 1.5, 5.0)
    until(lambda: distance(goal, se3(arm.receive.getActualTCPPose())) < 1e-7)
    assert arm.control.moveL_FK(HOME.tolist(), 0.5, 2.0)
    until(lambda: distance(flange(HOME), se3(arm.receive.getActualTCPPose())) < 1e-7)


def test_a_move_during_a_stream_ends_the_program_as_on_the_controller(arm: Client):
    arm.control.servoJ(HOME.tolist(), 0.0, 0.0, 0.002, 0.1, 300.0)
    assert not arm.control.moveJ(HOME.tolist(), 1.0, 1.0) and not arm.control.isProgramRunning()


def test_speed_commands_and_jogging(arm: Client):
    assert arm.control.speedJ([0, 0, 0, 0, 0, 0.5], 5.0)
    until(lambda: arm.q()[5] > 0.2)
    assert arm.receive.getActualQd()[5] == pytest.approx(0.5)
    assert arm.control.speedStop(10.0)
    height = arm.receive.getActualTCPPose()[2]
    assert arm.control.speedL([0, 0, 0.1, 0, 0, 0], 2.0)
    until(lambda: arm.receive.getActualTCPPose()[2] > height + 0.03)
    assert arm.receive.getActualTCPSpeed()[2] == pytest.approx(0.1, abs=1e-3)
    assert arm.control.speedStop(10.0)
    depth = arm.receive.getActualTCPPose()[2]
    assert arm.control.jogStart([0, 0, 0.1, 0, 0, 0], RTDEControlInterface.FEATURE_TOOL)
    until(lambda: arm.receive.getActualTCPPose()[2] < depth - 0.02)
    assert arm.control.jogStop()
    until(lambda: not any(arm.receive.getActualQd()))


def test_a_path_of_way_points_is_followed(arm: Client):
    path = MovePath()
    for offset in (0.1, 0.2):
        entry = [*(HOME + offset), 1.5, 5.0, 0.0]
        path.addEntry(PathEntry(PathEntry.MoveJ, PathEntry.PositionJoints, entry))
    assert arm.control.movePath(path, False)
    until(lambda: bool(np.allclose(arm.q(), HOME + 0.2)))


def test_kinematics_answers_agree_with_an_independent_chain(arm: Client):
    q = HOME + np.array([0.1, 0.2, -0.1, 0.3, 0.2, -0.4])
    assert distance(se3(arm.control.getForwardKinematics(q.tolist(), [0.0] * 6)), flange(q)) < 1e-9
    tool = [0.01, 0.02, 0.1, 0.1, 0.0, 0.2]
    assert distance(se3(arm.control.getForwardKinematics(q.tolist(), tool)), flange(q) * se3(tool)) < 1e-9
    goal = flange(q)
    pose = [*goal.translation, *pin.log3(goal.rotation)]
    np.testing.assert_allclose(arm.control.getInverseKinematics(pose, q.tolist()), q, atol=1e-7)
    assert distance(flange(arm.control.getInverseKinematics(pose)), goal) < 1e-7
    assert arm.control.getInverseKinematicsHasSolution(pose)
    assert not arm.control.getInverseKinematicsHasSolution([2.0, 0, 0, 0, 0, 0])
    assert distance(se3(arm.control.poseTrans(pose, tool)), goal * se3(tool)) < 1e-9
    assert arm.control.isJointsWithinSafetyLimits(q.tolist())
    assert not arm.control.isJointsWithinSafetyLimits([7.0, 0, 0, 0, 0, 0])
    assert arm.control.isPoseWithinSafetyLimits(pose)


def test_a_pose_out_of_reach_ends_the_program_and_the_call_says_so(arm: Client):
    assert arm.control.getInverseKinematics([2.0, 0, 0, 0, 0, 0]) == []
    assert not arm.control.isProgramRunning() and not arm.control.moveJ(HOME.tolist(), 1.0, 1.0)

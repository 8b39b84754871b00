"""A UR10e over the placement area: its poses, its planner among the bodies of a cell, its flange by plain matrices."""

import numpy as np
import pinocchio as pin
import pytest

from cell.motion import collision
from cell.motion.collision import CollisionModel
from cell.motion.kinematics import ArmKinematics, DenavitHartenberg, JointLimits, Joints
from cell.motion.planning import Planner
from cell.motion.trajectory import Trajectory
from drivers.interfaces import LinkTable

WORKING = np.array([2.8, -1.25, 2.0, -2.3, -1.57, 2.8])
"""Posture over the placement area: tool down, elbow up."""
DOWN = np.column_stack([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Rotation of a tool that points down with its y axis along the base's x axis."""
BASE_FROM_PLACE = pin.SE3(np.eye(3), np.array([0.75, 0.0, 0.05]))
_C = np.sqrt(0.5)
PLACE_FROM_BOARD_CENTRE = pin.SE3(
    np.column_stack([[0.0, -1.0, 0.0], [-_C, 0.0, -_C], [_C, 0.0, -_C]]), np.array([0.10, 0.32, 0.12])
)
FLANGE_FROM_PART = pin.SE3(DOWN, np.array([0.0, 0.0, 0.17]))
RESTING = [("part", "surface"), ("part", "table")]


def down(x: float, y: float, z: float) -> pin.SE3:
    return pin.SE3(DOWN, np.array([x, y, z]))


def link_frames(joints: Joints, table: DenavitHartenberg | LinkTable | None = None) -> list[np.ndarray]:
    """Base, the six frames that turn with a joint, and the flange, (4, 4). By a table, as drawn that of the UR10e,
    multiplied out with plain matrices, without Pinocchio."""
    table, frames, pose = table or DenavitHartenberg(), [np.eye(4)], np.eye(4)
    for q, d, a, alpha in zip(joints, table.d, table.a, table.alpha, strict=True):
        c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        frames.append(pose @ [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        pose = pose @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return [*frames, pose]


def independent_fk(joints: Joints, table: DenavitHartenberg | LinkTable | None = None) -> np.ndarray:
    return link_frames(joints, table)[-1]


def assert_within(trajectory: Trajectory, limits: JointLimits) -> None:
    """Finite differences of the samples against the limits."""
    dt = np.diff(trajectory.times)[:, None]
    speed = np.diff(trajectory.joints, axis=0) / dt
    acceleration = np.diff(speed, axis=0) / dt[1:]
    jerk = np.diff(acceleration, axis=0) / dt[2:]
    for name, values in {"speed": speed, "acceleration": acceleration, "jerk": jerk}.items():
        assert np.all(np.abs(values).max(axis=0) <= np.array(getattr(limits, name)) * 1.001), name


@pytest.fixture(scope="module")
def arm() -> ArmKinematics:
    return ArmKinematics()


@pytest.fixture(scope="module")
def planner(arm: ArmKinematics) -> Planner:
    solids = collision.arm_bodies() + collision.tool_bodies((0.070, 0.036, 0.020), FLANGE_FROM_PART)
    face_up = np.diag([1.0, -1.0, -1.0])
    plates = [
        ("fine plate", pin.SE3(face_up, np.array([-0.55, 0.25, 0.01])), (0.042, 0.036, 0.02)),
        ("large plate", pin.SE3(face_up, np.array([-0.60, -0.25, 0.01])), (0.21, 0.17, 0.02)),
    ]
    solids += collision.vehicle_bodies(plates) + collision.station_bodies(BASE_FROM_PLACE, PLACE_FROM_BOARD_CENTRE)
    return Planner(arm, CollisionModel(arm, solids))

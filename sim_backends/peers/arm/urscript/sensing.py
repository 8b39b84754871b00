"""URScript's commands that ask the arm and its controller, and the kinematics. Source: the maker's script manual."""

from __future__ import annotations

import math

import numpy as np

from sim_backends.models.arm import Safety
from sim_backends.models.arm_kinematics import Matrix, Vector, invert
from sim_backends.peers.arm.script.context import CYCLE, ProgramError
from sim_backends.peers.arm.urscript.environment import Commands, Environment, List, as_pose, matrix, numbers

_ZEROS = [0.0] * 6


def commands(environment: Environment) -> Commands:
    """By name; actual and target are one, as on an arm that follows exactly."""
    return {**_of_joints(environment), **_of_tool(environment), **_of_load(environment), **_kinematics(environment)}


def _of_joints(e: Environment) -> Commands:
    """Where the joints are, and whether they may be there."""

    def joints() -> List:
        return numbers(e.context.model.drive.q)

    def speeds() -> List:
        return numbers(e.context.model.drive.qd)

    def within_limits(q: List) -> bool:
        target = np.array(q if len(q) == 6 else [], float)
        return bool((np.abs(target) <= e.context.model.params.joint_limit).all())

    def history(steps: int = 0) -> List:
        return numbers(e.context.joints_before(int(steps)))

    return {
        "get_actual_joint_positions": joints, "get_joint_positions": joints, "get_target_joint_positions": joints,
        "get_actual_joint_speeds": speeds, "get_target_joint_speeds": speeds, "get_joint_speeds": speeds,
        "get_target_joint_accelerations": lambda: List(_ZEROS),
        "get_actual_joint_positions_history": history,
        "get_joint_temp": lambda joint: 30.0,
        "get_controller_temp": lambda: 30.0,
        "get_steptime": lambda: CYCLE,
        "is_steady": lambda: e.context.model.steady,
        "is_within_safety_limits": within_limits,
        "is_robot_stopped": lambda: not e.context.model.moving,
        "is_in_protective_stop": lambda: e.context.model.safety is Safety.PROTECTIVE_STOP,
    }  # fmt: skip


def _of_tool(e: Environment) -> Commands:
    """Where tool and flange are, and how fast."""

    def tool() -> List:
        return as_pose(e.context.model.drive.base_from_tcp())

    def flange() -> List:
        return as_pose(e.context.model.reported_flange())

    def tool_speed() -> List:
        drive = e.context.model.drive
        return numbers(drive.tcp_jacobian().dot(drive.qd))

    return {
        "get_actual_tcp_pose": tool, "get_target_tcp_pose": tool, "get_tcp_pose": tool,
        "get_actual_tool_flange_pose": flange, "get_target_tool_flange_pose": flange,
        "get_actual_tcp_speed": tool_speed, "get_target_tcp_speed": tool_speed,
        "get_tcp_offset": lambda: as_pose(e.context.model.drive.flange_from_tcp),
        "get_tool_current": lambda: 0.0,
        "get_target_waypoint": tool,
    }  # fmt: skip


def _of_load(e: Environment) -> Commands:
    """What the tool weighs, and what it feels."""

    def torques() -> List:
        model = e.context.model
        return numbers(model.drive.tcp_jacobian().T.dot(model.felt))

    return {
        "get_tcp_force": lambda: numbers(e.context.model.felt),
        "force": lambda: math.hypot(*e.context.model.felt[:3]),
        "get_joint_torques": torques,
        "get_target_payload": lambda: e.context.model.payload[0],
        "get_target_payload_mass": lambda: e.context.model.payload[0],
        "get_target_payload_cog": lambda: numbers(e.context.model.payload[1]),
        "get_target_payload_inertia": lambda: List(_ZEROS),
    }


def _kinematics(e: Environment) -> Commands:
    """From joints to poses and back."""

    def inverse(x: List, qnear: List | None, tcp: List | None) -> Vector:
        near = None if qnear is None else np.array(qnear, float)
        target = matrix(x)
        if tcp is not None:
            target = target.dot(invert(matrix(tcp))).dot(e.context.model.drive.flange_from_tcp)
        return e.context.solve(target, near)

    def get_inverse_kin(
        x: List,
        qnear: List | None = None,
        maxPositionError: float = 1e-10,
        maxOrientationError: float = 1e-10,
        tcp: List | None = None,
    ) -> List:
        return numbers(inverse(x, qnear, tcp))

    def has_solution(x: List, qnear: List | None = None, *others: object, tcp: List | None = None) -> bool:
        try:
            inverse(x, qnear, tcp)
        except ProgramError:
            return False
        return True

    def get_forward_kin(q: List | None = None, tcp: List | None = None) -> List:
        drive = e.context.model.drive
        place: Matrix = e.context.model.kinematics.forward(drive.q if q is None else np.array(q, float))
        return as_pose(place.dot(drive.flange_from_tcp if tcp is None else matrix(tcp)))

    return {
        "get_inverse_kin": get_inverse_kin, "get_inverse_kin_has_solution": has_solution,
        "get_forward_kin": get_forward_kin,
    }  # fmt: skip

"""Commands of the control script that move the arm, by number: moves, streams, compliance and contact.

Commands of the control script that ask or set something and move nothing, by number."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sim_backends.models.arm_kinematics import Matrix, Vector, matrix_from_pose, pose_from_matrix
from sim_backends.models.arm_motion import ForceMode, JointMove, JointSpeed, LinearMove, LinearSpeed, Servo, StopMotion
from sim_backends.peers.arm.script.context import CYCLE, Context, Job

_CONTACT_FORCE = 10.0
"""Force in N along the direction of motion that counts as contact."""

# --- moves ---


def _move_j(c: Context) -> Job | None:
    return _move_joints(c, c.doubles(0))


def _move_j_ik(c: Context) -> Job | None:
    return _move_joints(c, c.solve(c.pose(0)))


def _move_l(c: Context) -> Job | None:
    return _move_tool(c, c.pose(0))


def _move_l_fk(c: Context) -> Job | None:
    return _move_tool(c, c.forward(c.doubles(0)))


def _move_joints(c: Context, target: Vector) -> Job | None:
    c.require_free()
    c.end_background()
    return c.sync_or_async(c.wait(JointMove(target, c.double(6), c.double(7))))


def _move_tool(c: Context, target: Matrix) -> Job | None:
    c.require_free()
    c.end_background()
    return c.sync_or_async(c.wait(LinearMove(target, c.double(6), c.double(7))))


def _move_path(c: Context) -> Job | None:
    c.require_free()
    c.end_background()
    return c.sync_or_async(c.path())


def _stop_move(c: Context) -> Job | None:
    c.require_free()
    c.end_background()
    # Once an asynchronous stop was asked for, the script brakes linearly, whichever of the two commands comes.
    if c.integer(1) == 1:
        c.stop_is_linear = True
    return c.sync_or_async(c.wait(StopMotion(c.double(0), linear=c.stop_is_linear)))


# --- streams ---


def _servo_j(c: Context) -> None:
    _servo(c, c.doubles(0))


def _servo_l(c: Context) -> None:
    _servo(c, c.solve(c.pose(0)))


def _servo(c: Context, target: Vector) -> None:
    # A smoother target (longer look-ahead) or a softer controller (smaller gain) is followed later.
    lag = max(c.model.params.tracking_lag, c.double(9) * 300.0 / max(c.double(10), 1.0))
    c.take("servo")
    motion = c.model.motion
    if isinstance(motion, Servo):
        motion.target, motion.lag = target, lag
    else:
        c.model.start(Servo(target, lag))


def _servo_c(c: Context) -> None:
    target = c.doubles(0)
    begun = c.thread == "servo"
    c.take("servo")
    if not begun or not np.array_equal(target, c.streamed):
        c.streamed = target
        c.model.start(LinearMove(matrix_from_pose(target), c.double(6), c.double(7)))


def _servo_stop(c: Context) -> Job:
    c.thread = None
    return c.wait(StopMotion(c.double(0), linear=True))


def _speed_j(c: Context) -> None:
    c.speed_is_linear = False
    _speed(c, "speed", JointSpeed(c.doubles(0), c.double(6)))


def _speed_l(c: Context) -> None:
    c.speed_is_linear = True
    _speed(c, "speed", LinearSpeed(c.doubles(0), c.double(6)))


def _speed(c: Context, thread: str, wanted: JointSpeed | LinearSpeed) -> None:
    c.take(thread)
    motion = c.model.motion
    if type(motion) is type(wanted) and isinstance(motion, JointSpeed | LinearSpeed):
        motion.target, motion.acceleration = wanted.target, wanted.acceleration
    else:
        c.model.start(wanted)


def _speed_stop(c: Context) -> Job:
    c.thread = None
    return c.wait(StopMotion(c.double(0), linear=c.speed_is_linear))


def _jog_start(c: Context) -> None:
    speed, feature = c.doubles(0), round(c.double(6))
    turn = np.eye(3)
    if feature == 1:
        turn = c.model.drive.base_from_tcp()[:3, :3]
    elif feature == 2:
        turn = c.pose(8)[:3, :3]
    twist = np.concatenate((turn.dot(speed[:3]), turn.dot(speed[3:])))
    _speed(c, "jog", LinearSpeed(twist, c.double(7)))


def _jog_stop(c: Context) -> Job:
    c.thread = None
    return c.wait(StopMotion(1.2, linear=True))


# --- compliance and contact ---


def _force_mode(c: Context) -> None:
    """Compliance acts while no other motion does; it is not superposed on moves."""
    selection = np.array([float(c.integer(i)) for i in range(2, 8)])
    wanted = ForceMode(c.pose(0), selection, c.doubles(6), c.doubles(12))
    motion = c.model.motion
    if isinstance(motion, ForceMode):
        motion.task, motion.selection = wanted.task, wanted.selection
        motion.wrench, motion.limits = wanted.wrench, wanted.limits
    elif c.model.idle:
        c.model.start(wanted)


def tool_contact(c: Context, direction: Vector) -> int:
    """Cycles since the tool first felt the contact it now feels along `direction` (any if zero); 0 without."""
    force = c.model.felt[:3]
    length = math.hypot(*direction[:3])
    size = -float(force.dot(direction[:3])) / length if length > 0 else math.hypot(*force)
    c.touched = c.touched + 1 if size > 0.3 * _CONTACT_FORCE else 0
    return c.touched if size > _CONTACT_FORCE else 0


def _move_until_contact(c: Context) -> Job:
    c.require_free()
    direction = c.doubles(6)
    c.touched = 0
    c.model.start(LinearSpeed(c.doubles(0), c.double(12)))
    while not (steps := tool_contact(c, direction)):
        yield
    yield from _back_to(c, c.joints_before(steps))


def _back_to(c: Context, q: Vector) -> Job:
    yield from c.wait(StopMotion(3.0, linear=True))
    yield from c.wait(LinearMove(c.forward(q), 0.25, 1.2))


def _start_contact_detection(c: Context) -> None:
    c.touched = c.contact_steps = 0
    c.contact_direction = c.doubles(0)


def _stop_contact_detection(c: Context) -> None:
    c.contact_direction = None
    c.answer_integer(c.contact_steps)


def _contact_detected(c: Context) -> Job:
    c.end_background()
    return _back_to(c, c.joints_before(c.contact_steps))


MOTION_COMMANDS: dict[int, Callable[[Context], Job | None]] = {
    1: _move_j,
    2: _move_j_ik,
    3: _move_l,
    4: _move_l_fk,
    6: _force_mode,
    7: lambda c: c.wait(StopMotion(10.0, linear=True)),
    9: _speed_j,
    10: _speed_l,
    11: _servo_j,
    12: _servo_c,
    15: _speed_stop,
    16: _servo_stop,
    24: _servo_l,
    25: lambda c: c.answer_integer(tool_contact(c, c.doubles(0))),
    33: _stop_move,
    34: _stop_move,
    41: _jog_start,
    42: _jog_stop,
    45: _move_path,
    51: _move_until_contact,
    62: _start_contact_detection,
    63: _stop_contact_detection,
    64: lambda c: c.answer_integer(c.contact_steps),
    254: _contact_detected,
}
"""Command number → action."""


def _inverse_near(c: Context) -> None:
    tolerance = min(max(c.double(12), 1e-12), 1e-3)
    c.answer(c.solve(c.pose(0), c.doubles(6), tolerance))


def _forward_of(c: Context) -> None:
    # A request without a tool offset leaves another command's numbers in its registers: it means no offset.
    given = f"input_double_register_{c.offset + 6}" in c.registers.command_fields
    tool = c.pose(6) if given else np.eye(4)
    c.answer(pose_from_matrix(c.model.kinematics.forward(c.doubles(0)).dot(tool)))


def _forward_now(c: Context) -> None:
    c.answer(pose_from_matrix(c.model.drive.base_from_tcp()))


def _set_payload(c: Context) -> None:
    centre = c.doubles(1, 3)
    c.model.payload = (c.double(0), centre if centre.any() else c.model.payload[1])


def _set_tcp(c: Context) -> None:
    c.model.drive.flange_from_tcp = c.pose(0)


def _set_watchdog(c: Context) -> None:
    frequency = c.double(0)
    c.watchdog_period = 1.0 / frequency if frequency > 0 else None


def _joints_within_limits(c: Context) -> None:
    c.answer_integer(int(bool((np.abs(c.doubles(0)) <= c.model.params.joint_limit).all())))


def _joint_torques(c: Context) -> None:
    c.answer(c.model.drive.tcp_jacobian().T.dot(c.model.felt))


QUERY_COMMANDS: dict[int, Callable[[Context], None]] = {
    8: lambda c: c.model.zero_force(),
    17: _set_payload,
    26: lambda c: c.answer(np.array([CYCLE])),
    27: lambda c: c.answer(c.joints_before(c.integer(1))),
    28: _forward_now,
    29: _set_tcp,
    30: _inverse_near,
    31: lambda c: c.model.protective_stop("triggered by the program"),
    35: _set_watchdog,
    36: lambda c: c.answer_integer(int(c.has_solution())),
    37: _joints_within_limits,
    38: _joint_torques,
    39: lambda c: c.answer(pose_from_matrix(c.pose(0).dot(c.pose(6)))),
    40: lambda c: c.answer(pose_from_matrix(c.model.drive.flange_from_tcp)),
    43: _forward_now,
    44: _forward_of,
    46: lambda c: c.answer(c.solve(c.pose(0))),
    47: lambda c: c.answer_integer(int(c.model.steady)),
    54: lambda c: c.answer_integer(0),
    58: lambda c: c.answer(pose_from_matrix(c.model.reported_flange())),
    60: lambda c: c.answer_integer(int(c.has_solution())),
    61: lambda c: c.answer_integer(int(c.has_solution(c.doubles(6)))),
    65: _set_payload,
}
"""Command number → action. Settings of teaching, damping and external sensors have no effect on the simulated arm."""

"""Commands of the control script that ask or set something and move nothing, by number."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim_backends.models.arm_kinematics import pose_from_matrix
from sim_backends.peers.arm.script.context import CYCLE, Context


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

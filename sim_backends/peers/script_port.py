"""What the primary and the secondary port tell their clients: the version once, then the state ten times a second.

Numbers are big-endian: a package is i32 size, u8 type and its content, a part of it u32 size, u8 type and its content.
Source: the maker's client interface guide and `Universal_Robots_Client_Library`, `src/primary`; other parts of the
state are not sent.
"""

from __future__ import annotations

import struct
import zlib

from sim_backends.models.arm import ArmModel, Power, Safety
from sim_backends.models.arm_kinematics import Matrix, pose_from_matrix

_STATE, _MESSAGE = 16, 20
_LINEARISED = 2
"""The status of an arm that was calibrated in the factory."""
_PROJECT, _BUILT = b"URControl", b"10-11-2023, 00:00:00"


def version_message(version: tuple[int, int, int, int]) -> bytes:
    """The package that greets a client; `version` is major, minor, bug fix, build."""
    head = struct.pack(">Qbbb", 0, -2, 3, len(_PROJECT)) + _PROJECT
    return _package(_MESSAGE, head + struct.pack(">BBii", *version) + _BUILT)


def robot_state(model: ArmModel, runtime_state: int) -> bytes:
    """The state package: the robot's mode, where its tool is, and its kinematics; `runtime_state` is that of RTDE."""
    return robot_mode(model, runtime_state, _cartesian(model), _kinematics(model.params.dh))


def robot_mode(model: ArmModel, runtime_state: int, *others: bytes) -> bytes:
    """The state package with the robot's mode as its first part, and `others` behind it."""
    on = model.power is not Power.OFF
    stopped = model.safety is Safety.EMERGENCY_STOP, model.safety is Safety.PROTECTIVE_STOP
    running, paused = runtime_state == 2, runtime_state in (3, 4)
    flags = (True, True, on, *stopped, running, paused)
    speed = model.drive.speed_fraction
    content = struct.pack(">Q7?BBdddB", round(1e6 * model.time), *flags, int(model.power), 0, speed, speed, 1.0, 0)
    return _package(_STATE, b"".join([_part(0, content), *others]))


def _cartesian(model: ArmModel) -> bytes:
    """Pose of the tool in the base and of the tool on the flange."""
    drive = model.drive
    return _part(
        4, struct.pack(">12d", *pose_from_matrix(drive.base_from_tcp()), *pose_from_matrix(drive.flange_from_tcp))
    )


def _kinematics(table: Matrix) -> bytes:
    """The table that the controller computes with; a made-up checksum of each joint's row."""
    a, d, alpha, theta = table.T
    checksums = [zlib.crc32(row.tobytes()) for row in table]
    return _part(5, struct.pack(">6I24dI", *checksums, *theta, *a, *d, *alpha, _LINEARISED))


def _part(kind: int, content: bytes) -> bytes:
    return struct.pack(">IB", 5 + len(content), kind) + content


def _package(kind: int, content: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(content), kind) + content

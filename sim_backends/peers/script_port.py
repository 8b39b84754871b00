"""What the secondary port (30002) tells its clients: the version once, then the robot's mode ten times a second.

Numbers are big-endian: a package is i32 size, u8 type and its content. Source: the maker's client interface guide and
`Universal_Robots_Client_Library`, `src/primary`; other parts of the state are not sent.
"""

from __future__ import annotations

import struct

from sim_backends.models.arm import ArmModel, Power, Safety

_STATE, _MESSAGE = 16, 20
_PROJECT, _BUILT = b"URControl", b"10-11-2023, 00:00:00"


def version_message(version: tuple[int, int, int, int]) -> bytes:
    """The package that greets a client; `version` is major, minor, bug fix, build."""
    head = struct.pack(">Qbbb", 0, -2, 3, len(_PROJECT)) + _PROJECT
    return _package(_MESSAGE, head + struct.pack(">BBii", *version) + _BUILT)


def robot_mode(model: ArmModel, runtime_state: int) -> bytes:
    """The state package with its first part, the robot's mode; `runtime_state` is that of RTDE."""
    on = model.power is not Power.OFF
    stopped = model.safety is Safety.EMERGENCY_STOP, model.safety is Safety.PROTECTIVE_STOP
    running, paused = runtime_state == 2, runtime_state in (3, 4)
    flags = (True, True, on, *stopped, running, paused)
    speed = model.drive.speed_fraction
    content = struct.pack(">Q7?BBdddB", round(1e6 * model.time), *flags, int(model.power), 0, speed, speed, 1.0, 0)
    return _package(_STATE, struct.pack(">IB", 5 + len(content), 0) + content)


def _package(kind: int, content: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(content), kind) + content

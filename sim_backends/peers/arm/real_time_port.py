"""What the real-time port tells its clients 500 times a second: a packet of 1220 bytes, as controllers from 5.10 on do.

All numbers but the size are f64, big-endian. Source: the maker's table of the real-time client interface.
"""

from __future__ import annotations

import struct

from sim_backends.models.arm import Power
from sim_backends.peers.arm.rtde.registers import RegisterView

_PACKET = struct.Struct(">i152d")
_SIX, _THREE = (0.0,) * 6, (0.0,) * 3


def real_time_packet(view: RegisterView) -> bytes:
    """The packet for this cycle."""
    model, drive = view.model, view.model.drive
    q, qd = drive.q.tolist(), drive.qd.tolist()
    pose, speed = view.tcp_pose(), view.tcp_speed()
    mass, centre = model.payload
    mode = 253.0 if model.power is Power.RUNNING else 239.0
    on = 48.0 if model.power is not Power.OFF else 0.0
    fraction = drive.speed_fraction
    return _PACKET.pack(
        _PACKET.size, model.time,
        *q, *qd, *_SIX, *_SIX, *_SIX,  # target positions, speeds, accelerations, currents, moments
        *q, *qd, *_SIX, *_SIX,  # actual positions, speeds, currents; control currents
        *pose, *speed, *model.felt.tolist(), *pose, *speed,  # actual tool pose, speed, force; target pose, speed
        float(model.digital_inputs), *[30.0] * 6, 0.0, 0.0,  # inputs, motor temperatures, two times of the controller
        float(model.power), *[mode] * 6, float(model.safety_mode),
        *_SIX, *_THREE, *_SIX,  # unused, tool accelerometer, unused
        fraction, 0.0, fraction, 0.0, 48.0, on, 0.5, *[on] * 6,  # scaling, momentum, two unused, supplies
        float(model.digital_outputs), float(view.runtime_state),
        *_THREE, *_THREE, float(model.safety_mode), *_THREE,  # elbow place, speed; safety status; unused
        mass, *centre.tolist(), *_SIX,
    )  # fmt: skip

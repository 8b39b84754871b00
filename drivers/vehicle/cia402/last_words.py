"""What is sent to the drives when this process is killed: both quick stops, then the brakes' outputs."""

from __future__ import annotations

import struct

from drivers.vehicle.cia402 import objects as od
from drivers.vehicle.cia402.geometry import WheelDrives
from drivers.vehicle.cia402.states import QUICK_STOP

_EXPEDITED_4 = 0x23
"""SDO: set four bytes."""


def last_words(wheels: WheelDrives) -> list[tuple[int, bytes]]:
    """Identifiers and data. With a brake on an output, all outputs of the drives are set to where it is locked."""
    stop = od.CONTROLWORD.pack(QUICK_STOP) + od.TARGET_VELOCITY.pack(0)
    words = [(od.COMMAND + node, stop) for _ in range(3) for node in wheels.nodes]
    if wheels.brake_output is not None:
        level = 1 << wheels.brake_output if wheels.brake_locks else 0
        request = struct.pack("<BHBI", _EXPEDITED_4, od.OUTPUTS.index, od.OUTPUTS.sub, level)
        words += [(od.SDO_REQUEST + node, request) for node in wheels.nodes]
    return words

"""Asking both drives by SDO for what they otherwise tell in PDOs: nothing on them has to be set for that."""

from __future__ import annotations

import struct

from drivers.vehicle.cia402 import objects as od
from drivers.vehicle.cia402.bus import Absent, CanopenBus
from drivers.vehicle.cia402.drive import SideDrive
from drivers.vehicle.cia402.feedback import DriveFeedback
from drivers.vehicle.cia402.geometry import WheelDrives


def ask(bus: CanopenBus, feedback: DriveFeedback, wheels: WheelDrives) -> None:
    """Bring `feedback` up to date. Raises what `CanopenBus.read` does; a value that a drive lacks is left out."""
    for drive in feedback.drives:
        motion = struct.pack("<i", bus.read(drive.node, od.VELOCITY))
        if wheels.stop_input is not None:
            motion += struct.pack("<I", bus.read(drive.node, od.INPUTS))
        feedback.take(drive.node, od.MOTION, motion, in_pdo=False)
        code = _optional(bus, drive, od.ERROR_CODE)
        health = struct.pack("<H", code or 0)
        if (millivolts := _optional(bus, drive, od.DC_LINK)) is not None:
            health += struct.pack("<I", millivolts)
        feedback.take(drive.node, od.HEALTH, health, in_pdo=False)
        told = [bus.read(drive.node, entry) for entry in (od.STATUSWORD, od.POSITION, od.MODE_DISPLAY)]
        feedback.take(drive.node, od.STATUS, struct.pack("<Hib", *told), in_pdo=False)


def number(bus: CanopenBus, drive: SideDrive, entry: od.Entry) -> str:
    """A number of the drive as text, "" where it has none."""
    told = _optional(bus, drive, entry)
    return "" if told is None else str(told)


def _optional(bus: CanopenBus, drive: SideDrive, entry: od.Entry) -> int | None:
    try:
        return bus.read(drive.node, entry)
    except Absent:
        return None

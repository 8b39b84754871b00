"""How the drives' CAN bus is used, who else commands there, and what the drives tell of their supply."""

from __future__ import annotations

from collections.abc import Sequence

import can

from drivers.interfaces import Reading
from drivers.vehicle.can_interface import can_interface
from drivers.vehicle.cia402.drive import SideDrive
from drivers.vehicle.health import MOST_LOAD, bus_readings, most_bits


def readings(
    heard: Sequence[can.Message],
    seconds: float,
    bitrate: int,
    others: int,
    drives: Sequence[SideDrive],
    system_name: str | None,
    judged: bool,
) -> list[Reading]:
    """Figures of what was heard in `seconds` of the clock; `others` frames by which somebody else commanded.

    Without `judged`, on a clock that is not the wall's, the load has no limit. `system_name` is the computer's CAN
    interface, where it has one.
    """
    bits = sum(most_bits(frame) for frame in heard)
    found = [
        Reading(
            "bus load, at most", 100.0 * bits / (bitrate * seconds), "%",
            most=MOST_LOAD if judged else None, remedy="Take others off the CAN bus, or raise its bit rate.",
        ),
        Reading(
            "frames of another master", float(others), "", most=0.0,
            remedy="Find out who else sends SYNC, NMT, or commands to the drives, and end it.",
        ),
        *bus_readings(heard, None if system_name is None else can_interface(system_name)),
    ]  # fmt: skip
    # What is too low for the cells of its battery, the drive knows, and says by its error code.
    found += [
        Reading(f"supply, {drive.side} drive", 1e-3 * drive.millivolts, "V")
        for drive in drives
        if drive.millivolts is not None
    ]
    return found

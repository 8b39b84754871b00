"""How the vehicle's CAN bus is used, how evenly its feedback comes, and what it tells of voltages and temperatures.

Limits that nobody publishes are ours. Source: docs/reference/protocols.md, section 3; error counters: ISO 11898-1.

What Linux tells of a CAN interface: its bit rate, its state, its error counters. Read with `ip`; nothing is set."""

import json
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import can
import numpy as np
from cantools.database.can import Database

from drivers.interfaces import Reading

_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class CanInterface:
    """One interface; what it does not tell is None. `state` is as `ip` has it, such as ERROR-ACTIVE or STOPPED."""

    name: str
    up: bool
    bitrate: int | None = None
    state: str | None = None
    sent_errors: int | None = None
    received_errors: int | None = None


def can_interface(name: str) -> CanInterface | None:
    """The interface of this name as it is now; None where `ip` is missing or knows none of that name."""
    try:
        told = subprocess.run(
            ["ip", "-details", "-json", "link", "show", "dev", name],
            capture_output=True, text=True, timeout=_TIMEOUT_S,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return None
    return parse_interface(name, told.stdout) if told.returncode == 0 else None


def parse_interface(name: str, text: str) -> CanInterface | None:
    """The interface `name` in what `ip -details -json link show` prints; None where it is not in there."""
    try:
        rows = json.loads(text)
    except ValueError:
        return None
    for row in rows if isinstance(rows, list) else []:
        if isinstance(row, dict) and row.get("ifname") == name:
            data = _table(_table(row, "linkinfo"), "info_data")
            counters = _table(data, "berr_counter")
            return CanInterface(
                name, "UP" in row.get("flags", ()), _table(data, "bittiming").get("bitrate"), state=data.get("state"),
                sent_errors=counters.get("tx"), received_errors=counters.get("rx"),
            )  # fmt: skip
    return None


def _table(row: dict[str, Any], key: str) -> dict[str, Any]:
    value = row.get(key)
    return value if isinstance(value, dict) else {}


EVEN = "MotionState"
LONGEST_PERIOD_S = 0.060
"""Three of its cycles; a state may be 0.2 s old."""
MOST_LOAD = 70.0
LEAST_CHARGE = 20.0
WARNING_COUNT = 96
"""From here on a CAN controller is in its warning state."""
HOTTEST_DEG_C = 80.0
_WIRING = (
    "Measure 60 ohm between CAN high and low (two ends of 120 ohm), look at the plugs, and see that all have one bit "
    "rate."
)

Heard = Sequence[tuple[float, can.Message]]
"""Frames with the host time of their arrival, s of the clock."""


def readings(
    heard: Heard, seconds: float, bitrate: float, database: Database, interface: CanInterface | None, judge_times: bool
) -> list[Reading]:
    """Figures of what was heard in `seconds` of the clock, and of the computer's `interface`, where it has one. Without
    `judge_times`, on a clock that is not the wall's, times and load have no limits."""
    own = database.get_message_by_name(EVEN).frame_id
    arrived = [stamp for stamp, frame in heard if frame.arbitration_id == own and _of_the_vehicle(frame)]
    period = float(np.percentile(np.diff(arrived), 99)) if len(arrived) > 1 else np.nan
    bits = sum(most_bits(frame) for _, frame in heard)
    found = [
        Reading(
            "feedback period, p99", 1e3 * period, "ms",
            most=1e3 * LONGEST_PERIOD_S if judge_times else None,
            remedy="End programs that keep this computer busy; see whether others load the CAN bus.",
        ),
        Reading(
            "bus load, at most", 100.0 * bits / (bitrate * seconds), "%",
            most=MOST_LOAD if judge_times else None, remedy="Take others off the CAN bus, or raise its bit rate.",
        ),
        *bus_readings([frame for _, frame in heard], interface),
    ]  # fmt: skip
    return found + _told(heard, database)


def bus_readings(heard: Sequence[can.Message], interface: CanInterface | None) -> list[Reading]:
    """Error frames among what was heard, and the counters of the computer's `interface`, where it has one."""
    found = [Reading("error frames", float(sum(frame.is_error_frame for frame in heard)), "", most=0.0, remedy=_WIRING)]
    if interface is not None:
        for what, count in (("sending", interface.sent_errors), ("receiving", interface.received_errors)):
            if count is not None:
                found.append(
                    Reading(f"error counter, {what}", float(count), "", most=WARNING_COUNT - 1.0, remedy=_WIRING)
                )
    return found


def _told(heard: Heard, database: Database) -> list[Reading]:
    """Of the newest frames of each kind; a vehicle that does not send them tells nothing."""
    newest = {frame.arbitration_id: frame for _, frame in heard if _of_the_vehicle(frame)}
    told: dict[str, dict[str, float]] = {}
    for message in database.messages:
        frame = newest.get(message.frame_id)
        wanted = message.name.startswith(("Battery", "System", "MotorDriver"))
        if wanted and frame is not None and len(frame.data) == message.length:
            signals = message.decode(bytes(frame.data), decode_choices=False)
            told[message.name] = cast(dict[str, float], signals)
    found: list[Reading] = []
    if (system := told.get("SystemState")) is not None:
        # How many cells it has, and what is too low for them, the vehicle knows, and says in its error bits.
        found.append(Reading("battery", system["BatteryVoltage"], "V"))
    if (battery := told.get("BatteryState")) is not None:
        charge, warm = battery["StateOfCharge"], battery["Temperature"]
        found.append(Reading("charge", charge, "%", least=LEAST_CHARGE, remedy="Charge the vehicle."))
        found.append(
            Reading("battery's temperature", warm, "°C", 0.0, most=50.0, remedy="Let the battery cool down or warm up.")
        )
    motors = [signals for name, signals in told.items() if name.startswith("MotorDriver")]
    if motors:
        hottest = max(max(motor["DriverTemperature"], motor["MotorTemperature"]) for motor in motors)
        found.append(
            Reading("hottest motor or its driver", hottest, "°C", most=HOTTEST_DEG_C, remedy="Let the vehicle stand.")
        )
    return found


def _of_the_vehicle(frame: can.Message) -> bool:
    """Whether it may be the vehicle's: data with a short identifier. A long one of the same number is another's."""
    return not (frame.is_error_frame or frame.is_extended_id or frame.is_remote_frame)


def most_bits(frame: can.Message) -> int:
    """Bits of a data frame on the bus with as many stuffed bits as there can be, and the pause behind it."""
    header, stuffed = (64, 54) if frame.is_extended_id else (44, 34)
    data = 0 if frame.is_remote_frame else 8 * len(frame.data)
    return header + data + (stuffed + data - 1) // 4 + 3

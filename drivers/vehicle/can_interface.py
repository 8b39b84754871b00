"""What Linux tells of a CAN interface: its bit rate, its state, its error counters. Read with `ip`; nothing is set."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from typing import Any

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
                name,
                "UP" in row.get("flags", ()),
                _table(data, "bittiming").get("bitrate"),
                state=data.get("state"),
                sent_errors=counters.get("tx"),
                received_errors=counters.get("rx"),
            )
    return None


def _table(row: dict[str, Any], key: str) -> dict[str, Any]:
    value = row.get(key)
    return value if isinstance(value, dict) else {}

"""The truth endpoint of a served simulated cell, from this side: ask for the truth, cause a fault."""

from __future__ import annotations

import json
import socket
from typing import Any

from drivers.errors import CellError

TIMEOUT_S = 5.0


def ask_truth(address: str) -> dict[str, Any]:
    """The whole truth of a simulated cell; raises `CellError` when its endpoint does not answer."""
    truth: dict[str, Any] = _asked(address, {"op": "truth"}, "does not tell its truth")["truth"]
    return truth


def cause_fault(address: str, name: str) -> None:
    """Cause a fault by its name; raises `CellError` when that was not taken."""
    _asked(address, {"op": "fault", "name": name}, f"did not take the fault {name}")


def make_ready(address: str, drawing: str) -> None:
    """Have the station of a drawing set up and its part put into the claw; raises `CellError` when that was not
    taken."""
    _asked(address, {"op": "make_ready", "drawing": drawing}, "was not made ready for the job")


def clear_faults(address: str) -> None:
    """Take away all causes of faults; raises `CellError` when that was not taken."""
    _asked(address, {"op": "reset"}, "did not take its faults away")


def _asked(address: str, request: dict[str, str], failed: str) -> dict[str, Any]:
    host, port = address.rsplit(":", 1)
    try:
        with socket.create_connection((host, int(port)), timeout=TIMEOUT_S) as link, link.makefile("rwb") as file:
            file.write(json.dumps(request).encode() + b"\n")
            file.flush()
            answer: dict[str, Any] = json.loads(file.readline())
    except (OSError, ValueError) as error:
        raise CellError(f"the simulated cell at {address} {failed}: {error}") from error
    if not answer.get("ok"):
        raise CellError(f"the simulated cell at {address} {failed}: {answer.get('error')}")
    return answer

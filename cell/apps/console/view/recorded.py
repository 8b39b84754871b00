"""How the cell moved in a run, by its `record.mcap`: for the replay with a slider.

Run as a module by the server, in a process of its own: `python -m cell.apps.console.view.recorded FILE`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from cell.apps.console.host.rehearsal import end_with_parent
from cell.run.record.reading import Parts, messages, said
from drivers.errors import CellError

JOINTS, VEHICLE, EVENT = "/joints", "/vehicle/state", "/sequence/event"
RAIL = "rail"
PERIOD_S, MOST = 0.1, 40_000
"""Seconds between two moments that are kept, and how many are at most: more than an hour."""


def moves(record: Path) -> bool:
    """Whether a record tells where the arm was, so that it can be replayed."""
    try:
        return next(said(record, Parts(), (JOINTS,)), None) is not None
    except (CellError, OSError):
        return False


def motion(record: Path) -> dict[str, Any]:
    """Ten times a second from the record's beginning, as docs/reference/console.md has it: joints in rad, rail in m,
    vehicle in m and rad; None where not told yet. Raises `CellError` for a file that is no record."""
    told = sorted(messages(record, (JOINTS, VEHICLE, EVENT)), key=lambda message: message[1])
    begun = told[0][1] if told else 0
    rows: list[tuple[float, Any, Any, Any]] = []
    steps: list[dict[str, Any]] = []
    joints: list[float] | None = None
    rail: float | None = None
    vehicle: list[float] | None = None
    for topic, at, message in told:
        now = round(1e-9 * (at - begun), 3)
        if topic == EVENT:
            if message["kind"] == "step_started":
                steps.append({"name": message["step"], "begin": now, "end": None})
            elif message["kind"] in ("step_done", "step_failed") and steps:
                steps[-1]["end"] = now
            continue
        if topic == VEHICLE:
            vehicle = [round(float(message[key]), 5) for key in ("x", "y", "yaw")]
        elif [joint.name for joint in message.joints] == [RAIL]:
            rail = round(message.joints[0].position, 6)
        else:
            joints = [round(joint.position, 5) for joint in message.joints if joint.name != RAIL]
        row = now, joints, rail, vehicle
        # The newest of each tenth of a second.
        if rows and int(rows[-1][0] / PERIOD_S) == int(now / PERIOD_S):
            rows[-1] = row
        elif len(rows) < MOST:
            rows.append(row)
    columns = [list(column) for column in zip(*rows, strict=True)] or [[], [], [], []]
    return {**dict(zip(("times", "joints", "rail", "vehicle"), columns, strict=True)), "steps": steps}


if __name__ == "__main__":
    end_with_parent()
    print(json.dumps(motion(Path(sys.argv[1]))))

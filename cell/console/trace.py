"""How the cell moved in a run, as `trace.json` in its folder: for the replay with a slider, ten times a second.

Taken on the cell's own clock, so also of a run on the virtual one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from cell.devices.devices import Devices
from cell.run.run import Run
from drivers.errors import CellError
from statemachine.step import Event

FILE = "trace.json"
PERIOD_S = 0.1
MOST = 40_000
"""Places that are kept at most: more than an hour."""
OLD_S = 1.0
LONGEST_S = 86_400.0


class Trace:
    """Notes where the devices are; an observer of the run, whose steps it notes, too."""

    def __init__(self, devices: Devices, *, virtual: bool) -> None:
        """On the virtual clock asking the rail takes no time of its line."""
        self._devices = devices
        self._virtual = virtual
        self._begun = devices.clock.now()
        self._times: list[float] = []
        self._joints: list[list[float] | None] = []
        self._rail: list[float | None] = []
        self._vehicle: list[list[float] | None] = []
        self._steps: list[dict[str, Any]] = []

    @property
    def _now(self) -> float:
        return round(self._devices.clock.now() - self._begun, 3)

    def __call__(self, event: Event) -> None:
        """A step begins or ends."""
        if event.kind == "step_started":
            self._steps.append({"name": event.step, "begin": self._now, "end": None})
        elif event.kind in ("step_done", "step_failed") and self._steps:
            self._steps[-1]["end"] = self._now

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Inside this context places are noted."""
        with self._devices.clock.alarm(PERIOD_S, self._note):
            yield

    def _note(self) -> float | None:
        if len(self._times) >= MOST:
            return None
        devices, old = self._devices, OLD_S * self._devices.clock.rate
        joints = _told(lambda: [round(float(q), 5) for q in devices.arm.state(old).joints])
        vehicle = _told(lambda: _pose(devices.vehicle.state(old)))
        self._times.append(self._now)
        self._joints.append(joints)
        self._rail.append(self._place())
        self._vehicle.append(vehicle)
        return PERIOD_S

    def _place(self) -> float | None:
        """Of the rail, as its own motion has read it; on the virtual clock as it is."""
        if "rail" not in self._devices:
            return None
        rail = self._devices.rail
        if self._virtual:
            place: float | None = _told(lambda: round(float(rail.state().position), 6))
            return place
        readings: Sequence[Any] = getattr(rail.motion, "readings", ())
        return round(float(readings[-1][1]), 6) if len(readings) else (self._rail[-1] if self._rail else None)

    def as_dict(self) -> dict[str, Any]:
        """See docs/console.md, `/api/runs/ID/replay`."""
        return {"times": self._times, "joints": self._joints, "rail": self._rail, "vehicle": self._vehicle,
                "steps": self._steps}  # fmt: skip

    def write(self, folder: Path) -> None:
        """Into the run's folder; without it the run has no replay, and is none the worse."""
        with suppress(OSError):
            (folder / FILE).write_text(json.dumps(self.as_dict()), encoding="utf-8")


def traced(devices: Devices, run: Run[Any], trace: Trace) -> None:
    """Note a run until its end, and write the trace into its folder. Blocks; for a thread of its own on the wall."""
    with trace.taken():
        events = run.events()
        while (event := events.take()) is not None:
            trace(event)
        run.ended(LONGEST_S)
    if run.folder is not None:
        trace.write(run.folder)


def _told(read: Callable[[], Any]) -> Any:
    try:
        return read()
    except CellError:
        return None


def _pose(state: Any) -> list[float]:
    return [round(float(value), 5) for value in (state.x, state.y, state.yaw)]

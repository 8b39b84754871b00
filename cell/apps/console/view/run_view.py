"""What goes on in a run, as the page shows it: by its own events, which wait for nobody; its pictures and its cloud.

These are taken from what the steps have kept already; who shows them computes with copies, and only as many as are
shown.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.procedures.sweep.swath import SweepCollector, Sweeping
from cell.run.runs import Run
from drivers.interfaces import Frame
from statemachine.step import Event

KEPT_FAULTS = 8


class RunView:
    """One run that was begun. `expected` are the seconds that its steps took the last time, by their names."""

    def __init__(self, run: Run[object], steps: Sequence[str], job: str | None, expected: Mapping[str, float]) -> None:
        self.run = run
        self.faults: list[dict[str, object]] = []
        self.asked: dict[str, object] | None = None
        self.ended: dict[str, object] | None = None
        self._job = job
        self._expected = expected
        self._begun = time.time()
        self._events = run.events()
        self._held = False
        self._step: str | None = None
        self._step_begun = time.monotonic()
        self._attempt, self._fraction, self._text = 1, 0.0, ""
        self._rows = {name: _row(name) for name in steps}

    def news(self) -> list[dict[str, object]]:
        """Take what has happened since, and give it in words for a list."""
        told: list[dict[str, object]] = []
        while (event := self._events.take(0.0)) is not None:
            self._take(event)
            if event.kind != "progress":
                told.append(
                    {"type": "event", "t": event.at, "step": event.step, "kind": event.kind, "text": words(event)}
                )
        return told

    @property
    def over(self) -> bool:
        """Whether the run has ended and everything that it told was taken."""
        return self.run.done and self._events.closed

    def as_dict(self) -> dict[str, object]:
        """For the page: see docs/reference/console.md."""
        run = self.run
        paused = run.control.paused()
        state = "asking" if self.asked is not None else "paused" if self._held else "pausing" if paused else "running"
        return {
            "kind": run.kind, "run": None if run.folder is None else run.folder.name, "job": self._job,
            "state": state, "step": self._step, "attempt": self._attempt, "fraction": round(self._fraction, 3),
            "text": self._text, "elapsed_s": round(time.time() - self._begun, 1), "left_s": self._left(),
            "steps": list(self._rows.values()),
        }  # fmt: skip

    def _left(self) -> float | None:
        """Wall seconds until the end, if it takes what it took the last time."""
        if self._step is None or self._step not in self._expected:
            return None
        names = list(self._rows)
        later = names[names.index(self._step) + 1 :]
        if any(name not in self._expected for name in later):
            return None
        here = max(0.0, self._expected[self._step] - (time.monotonic() - self._step_begun))
        return round(here + sum(self._expected[name] for name in later), 1)

    def _row_of(self, step: str) -> dict[str, Any]:
        """A step's row; what comes before the first step, as a first calibration does, stands before it."""
        if step not in self._rows:
            first = all(row["state"] == "open" for row in self._rows.values())
            self._rows = {step: _row(step), **self._rows} if first else {**self._rows, step: _row(step)}
        return self._rows[step]

    def _take(self, event: Event) -> None:
        step, data = event.step, event.data
        of_step = event.kind in ("step_started", "step_done", "step_failed", "progress")
        row = self._row_of(step) if step and of_step else None
        match event.kind:
            case "step_started" if row is not None:
                self._step, self._attempt = step, int(str(data["attempt"]))
                self._begin(row)
            case "progress":
                self._step = step
                self._fraction, self._text = float(str(data["fraction"])), str(data["text"])
                if row is not None and row["state"] == "open":
                    row["state"] = "active"
            case "step_done" if row is not None:
                row |= {"state": "done", "duration_s": round(float(str(data["duration_s"])), 2)}
            case "step_failed" if row is not None:
                row |= {"state": "failed", "reason": str(data["reason"])}
            case "fault":
                code = str(data["code"])
                fault = {"device": code.rpartition(".")[0], "code": code, "text": str(data["reason"])}
                self.faults.append({**fault, "remedy": str(data.get("remedy", "")), "t": event.at})
                del self.faults[:-KEPT_FAULTS]
            case "confirm_needed":
                self.asked = {"number": int(str(data["number"])), "step": step, "code": str(data["code"]),
                              "reason": str(data["reason"])}  # fmt: skip
            case "confirmed" | "safe_stop" | "run_ended":
                self.asked = None
            case "paused" | "going_on":
                self._held = event.kind == "paused"
        if event.kind == "run_ended":
            self._step, self._text = None, "writing the report"
            folder = None if self.run.folder is None else self.run.folder.name
            told = {"outcome": str(data["outcome"]), "reason": str(data["reason"])}
            self.ended = {"run": folder, "kind": self.run.kind, **told, "t": event.at}

    def _begin(self, row: dict[str, object]) -> None:
        # What went before without an end of its own, as a calibration does, has ended.
        for before in self._rows.values():
            before["state"] = "done" if before["state"] == "active" else before["state"]
        self._fraction, self._text, self._step_begun = 0.0, "", time.monotonic()
        row |= {"state": "active", "reason": "", "retries": int(str(row["retries"])) + (self._attempt > 1)}


def words(event: Event) -> str:
    """An event in one line for people."""
    data = event.data
    for key in ("text", "reason"):
        if key in data:
            return str(data[key])
    if event.kind == "state":
        return f"{data['from']} → {data['to']}"
    return ", ".join(f"{key} {value}" for key, value in data.items() if isinstance(value, str | int | float))[:200]


def _row(name: str) -> dict[str, Any]:
    return {"name": name, "state": "open", "duration_s": None, "retries": 0, "reason": ""}


WIDTH = 640
"""Pictures are made smaller by whole numbers until they are no wider."""
STRIPE_POINTS = 160
ROWS = 12
"""Each so many-th row of a profile is shown."""
TARGET_PICTURES = ("board", "large", "target")
"""How the names of the target camera's pictures begin."""

Sent = tuple[dict[str, object], bytes]


class Pictures:
    """The newest picture of a run that was not given yet."""

    def __init__(self) -> None:
        self._given: Frame | None = None
        self._found: object = None

    def newest(self, run: Run[object]) -> tuple[dict[str, object], NDArray[np.uint8]] | None:
        """Header and grey image (rows, columns), a copy; None when nothing new was looked at."""
        last = None if run.frames is None else run.frames.last
        found = None if run.frames is None else run.frames.found
        board = None
        if found is not None and found is not self._found:
            # Once more, with the board, which was found in it since.
            self._found = found
            what, (frame, board) = "board", found
        elif last is not None and last[1] is not self._given:
            what, frame = last
        else:
            return None
        self._given = frame
        step = max(1, -(-frame.image.shape[1] // WIDTH))
        small = np.ascontiguousarray(frame.image[::step, ::step])
        header = {
            "type": "picture",
            "camera": "target_camera" if what.startswith(TARGET_PICTURES) else "scan_camera",
            "what": what, "width": small.shape[1], "height": small.shape[0], "scale": 1.0 / step,
            "board": None if board is None else (board / step).round(1).tolist(), "stripe": None,
        }  # fmt: skip
        if what == "stripe" and run.sweeping is not None:
            header["stripe"] = _stripe(run.sweeping.collector, frame, step)
        return header, small


def _stripe(collector: SweepCollector, frame: Frame, step: int) -> list[list[float]] | None:
    """Where the stripe was found in this frame, in pixels of the small picture."""
    try:
        line = collector.frame_ids.index(frame.frame_id, max(0, len(collector.frame_ids) - 8))
    except ValueError:
        return None
    centres = collector.builder.centres(line)
    rows = np.flatnonzero(np.isfinite(centres))
    rows = rows[:: max(1, len(rows) // STRIPE_POINTS)]
    return [[round(float(centres[row]) / step, 1), round(float(row) / step, 1)] for row in rows]


class GrowingCloud:
    """The points of a sweep as they come, placed by where rail and arm were read last: good for looking at only."""

    def __init__(self) -> None:
        self._present: Sweeping | None = None
        self._sweep = -1
        self._next = 0
        self._total = 0
        self._points: list[NDArray[np.float32]] = []
        self._told: object = None

    def increment(self, run: Run[object], flange: NDArray[np.float64] | None, rail: object) -> Sent | None:
        """The lines that came since; `flange` (4, 4) is base_from_flange now and `rail` the rail's motion."""
        present = run.sweeping
        if present is None:
            return None
        if present is not self._present:
            self._sweep += 1
            self._present, self._next = present, 0
        collector = present.collector
        known = min(len(collector.times), collector.builder.lines)
        if flange is None or known <= self._next:
            return None
        times = np.array(collector.times[self._next : known])
        places = _places(rail, times)
        lines = collector.builder.seen(self._next)[: known - self._next, ::ROWS].copy()
        header = {"type": "cloud", "sweep": self._sweep, "from": self._total, "reset": self._total == 0, "final": False}
        self._next = known
        geometry = collector.geometry
        mount = geometry.flange_from_camera
        moved = lines + places[:, None, None] * np.asarray(geometry.rail_direction)
        in_flange = moved @ mount.rotation.T + mount.translation
        points = (in_flange @ flange[:3, :3].T + flange[:3, 3]).reshape(-1, 3)
        points = points[np.isfinite(points[:, 0])]
        if not len(points):
            return None
        self._total += len(points)
        rows = np.empty((len(points), 4), dtype="<f4")
        rows[:, :3] = points
        surface = present.base_from_surface
        rows[:, 3] = present.nominal.deviations((points - surface.translation) @ surface.rotation)
        self._points.append(rows[:, :3])
        return {**header, "count": len(rows)}, rows.tobytes()

    def final(self, run: Run[object]) -> Sent | None:
        """All points anew, with their distances from the surface where it was found; once, as soon as it was."""
        found, present = run.registered, run.sweeping
        if found is None or found is self._told or present is None or not self._points:
            return None
        self._told = found
        points = np.concatenate(self._points)
        deviations = present.nominal.deviations((points - found.translation) @ found.rotation)
        rows = np.column_stack([points, deviations]).astype("<f4")
        header = {"type": "cloud", "sweep": self._sweep, "from": 0, "reset": True, "final": True, "count": len(rows)}
        return header, rows.tobytes()


def _places(rail: object, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the rail was at these host times by its own readings, m; 0 for a sweep by the arm."""
    readings = list(getattr(rail, "readings", ()))
    if len(readings) < 2:
        return np.zeros(len(times))
    told = np.array([row[:2] for row in readings])
    return np.asarray(np.interp(times, told[:, 0], told[:, 1]))

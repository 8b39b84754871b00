"""What goes on in a run, as the page shows it: kept up to date from the run's own events, which wait for nobody."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from cell.run.run import Run
from statemachine.step import Event

KEPT_FAULTS = 8


class RunView:
    """One run that was begun. `expected` are the seconds that its steps took the last time, by their names."""

    def __init__(self, run: Run[Any], steps: Sequence[str], job: str | None, expected: Mapping[str, float]) -> None:
        self.run = run
        self.faults: list[dict[str, Any]] = []
        self.asked: dict[str, Any] | None = None
        self.ended: dict[str, Any] | None = None
        self._job = job
        self._expected = expected
        self._begun = time.time()
        self._events = run.events()
        self._held = False
        self._step: str | None = None
        self._step_begun = time.monotonic()
        self._attempt, self._fraction, self._text = 1, 0.0, ""
        self._rows = {name: _row(name) for name in steps}

    def news(self) -> list[dict[str, Any]]:
        """Take what has happened since, and give it in words for a list."""
        told: list[dict[str, Any]] = []
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

    def as_dict(self) -> dict[str, Any]:
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
        row = self._row_of(step) if step and _is_step(event) else None
        match event.kind:
            case "step_started" if row is not None:
                # What went before without an end of its own, as a calibration does, has ended.
                for before in self._rows.values():
                    before["state"] = "done" if before["state"] == "active" else before["state"]
                self._step, self._attempt, self._fraction, self._text = step, int(str(data["attempt"])), 0.0, ""
                self._step_begun = time.monotonic()
                row |= {"state": "active", "reason": "", "retries": row["retries"] + (self._attempt > 1)}
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
                fault = {"device": _device(str(data["code"])), "code": str(data["code"]), "text": str(data["reason"])}
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
            folder = None if self.run.folder is None else self.run.folder.name
            self._step, self._text = None, "writing the report"
            told = {"outcome": str(data["outcome"]), "reason": str(data["reason"])}
            self.ended = {"run": folder, "kind": self.run.kind, **told, "t": event.at}


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


def _is_step(event: Event) -> bool:
    return event.kind in ("step_started", "step_done", "step_failed", "progress")


def _device(code: str) -> str:
    return code.partition(".")[0] if "." in code else ""

"""The queue of parts that a page began: a batch, its counters, and what a person wants of the parts to come."""

import time

from cell.run.runs import Run
from cell.run.session.supervisor import Cell
from drivers.errors import InterlockError
from statemachine.step import Event

LOOK_S = 0.05
"""Wall seconds between two looks at what is wanted while the queue holds."""
WANTED = {
    "run": "the queue goes on",
    "hold": "the queue holds after this part, until it is told to go on",
    "end": "the queue ends after this part",
}


class PartQueue:
    """One batch at a time. The last one is shown until another one begins."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._run: Run[object] | None = None
        self._wanted = "run"
        self.job: str | None = None
        """Of the parts, until the last one has ended."""
        self._shown: dict[str, object] | None = None

    def perform(self, job: str, count: int, *, at_start: bool) -> None:
        """Do the parts, one after the other; raises what keeps the first one from being begun."""
        self.require_none()
        self._wanted, self.job, self._run, stops = "run", job, None, self._cell.stops
        shown: dict[str, object] = {"job": job, "part": 0, "count": count, "counts": {}}
        shown |= {"reason": "", "state": "running"}
        self._shown = shown

        def seen(event: Event) -> None:
            self._run = self._cell.current or self._run
            if "counts" in event.data:
                shown.update({key: event.data[key] for key in ("part", "count", "counts")})
                self._between(shown, stops)

        try:
            shown["reason"] = self._cell.run_batch(job, count, seen, at_start=at_start).reason
        finally:
            self.job, shown["state"] = None, "ended"

    def require_none(self) -> None:
        """Raise `InterlockError` while a batch is going on, also where it holds between two parts."""
        if self.job is not None:
            raise InterlockError("cell", f"a batch of {self.job} is going on; let the queue go on, or end it")

    def want(self, what: str) -> str:
        """What is to become of the parts after this one, one of `WANTED`; `InterlockError` where there are none."""
        if self.job is None:
            raise InterlockError("cell", "no batch is going on; start a job for more than one part")
        self._wanted = what
        return WANTED[what]

    def as_dict(self) -> dict[str, object] | None:
        """The batch as the page shows it (docs/reference/console.md), None before the first."""
        return None if self._shown is None else {**self._shown, "wanted": self._wanted}

    def close(self) -> None:
        """No other part is begun."""
        self._wanted = "end"

    def _between(self, shown: dict[str, object], stops: int) -> None:
        """Called after each part: the next one begins when this returns, not after a stop (`Cell.run_batch`)."""
        if self._run is not None and self._wanted == "hold":
            # Whoever comes near meanwhile may bump the scan head or move the station.
            with self._run.control.held():
                while self._wanted == "hold" and self._cell.stops == stops:
                    shown["state"] = "holding"
                    time.sleep(LOOK_S)
        shown["state"] = "running"
        if self._run is not None and self._wanted == "end":
            self._run.end_batch()

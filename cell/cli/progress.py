"""Progress bars while a run goes on."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from statemachine.step import Event

SAID = ("note", "paused", "going_on")
"""Kinds of events whose text is shown as it is."""


class ProgressDisplay:
    """Bars for the steps, a row each; an observer for `Cell.run` and `Cell.calibrate`. Writes to standard error."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.fields[step]:<16}"),
            BarColumn(bar_width=30),
            TextColumn("{task.percentage:>3.0f}%"),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
            console=self.console,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> ProgressDisplay:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._progress.stop()

    def __call__(self, event: Event) -> None:
        """Take an event of the runner."""
        step = event.step
        if event.kind in SAID and "text" in event.data:
            self.console.print(str(event.data["text"]), markup=False)
        elif event.kind == "confirm_needed":
            number = event.data["number"]
            said = f"waiting for a person, question {number}: {event.data['reason']}"
            self.console.print(said, style="bold yellow", markup=False)
            answer = f"cell confirm --question {number} (or cell abort)"
            self.console.print(f"when that is done, in another shell here: {answer}", markup=False)
        elif event.kind == "confirmed":
            self.console.print(f"confirmed by {event.data['by']}", markup=False)
        elif step is None:
            return
        elif event.kind == "step_started":
            self._task(step)
        elif event.kind == "progress":
            fraction = event.data["fraction"]
            assert isinstance(fraction, float | int)
            self._progress.update(self._task(step), completed=fraction, description=str(event.data["text"]))
        elif event.kind == "step_done":
            self._progress.update(self._task(step), completed=1.0, description="done")
            self._progress.stop_task(self._task(step))
        elif event.kind == "step_failed":
            self._progress.update(self._task(step), description=f"[red]{event.data['reason']}"[:90])
            self._progress.stop_task(self._task(step))

    def _task(self, step: str) -> TaskID:
        if step not in self._tasks:
            self._tasks[step] = self._progress.add_task("", total=1.0, step=step)
        return self._tasks[step]

"""Progress bars while a run goes on."""

from __future__ import annotations

import getpass
import os
import select
import sys
import termios
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column

from statemachine.control import RunControl
from statemachine.step import Event

SAID = ("note", "paused", "going_on")
"""Kinds of events whose text is shown as it is."""
LOOPS = 90
"""A first dry run compiles more loops than this, and keeps them on disk."""


def tell_question(event: Event, console: Console | None = None) -> None:
    """An observer that says what a person is asked, and how it is answered; without a console on standard error."""
    console = console or Console(stderr=True)
    if event.kind == "confirm_needed":
        number = event.data["number"]
        said = f"waiting for a person, question {number}: {event.data['reason']}"
        console.print(said, style="bold yellow", markup=False)
        answer = f"cell confirm --question {number} (or cell abort)"
        console.print(f"when that is done, in another shell here: {answer}", markup=False)
    elif event.kind == "confirmed":
        console.print(f"confirmed by {event.data['by']}", markup=False)


def answer_here(control: RunControl, console: Console) -> None:
    """Wait until the question that a run asks now is answered: at this terminal, or elsewhere."""
    termios.tcflush(sys.stdin, termios.TCIFLUSH)  # what was typed before the question is no answer
    asked = control.question
    console.print('or type here: "ready" and Enter; "end" ends the batch', markup=False)
    while asked is not None and control.question == asked and not (control.answer() or control.token.reason):
        typed = os.read(sys.stdin.fileno(), 1000) if select.select([sys.stdin], [], [], 0.1)[0] else b"\n"
        if typed.strip() == b"ready":
            control.confirm(getpass.getuser(), asked[0])
        elif typed.strip() == b"end" or not typed:
            control.abort("ended at the terminal")


def kept_loops() -> int:
    """How many compiled loops are kept for this Python."""
    here = Path(__file__).parents[3]
    roots = [Path(folder)] if (folder := os.environ.get("NUMBA_CACHE_DIR")) else [here / "cell", here / "sim_backends"]
    return sum(1 for root in roots for _ in root.rglob(f"*.py{sys.version_info.major}{sys.version_info.minor}.nbi"))


class _Unheard(Console):
    """A console that goes quiet once nobody reads it; the library's ends the process, in the middle of a motion."""

    def on_broken_pipe(self) -> None:
        """See `rich.console.Console.on_broken_pipe`."""
        self.quiet = True


class ProgressDisplay:
    """Bars for the steps, a row each; an observer for `Cell.run` and `Cell.calibrate`. Writes to standard error.

    Each row keeps to one line and its bar to its place, however long a text is. With `compiles` it is said first that
    loops will be compiled, if they are.
    """

    def __init__(self, *, compiles: bool = False) -> None:
        self.console = _Unheard(stderr=True)
        columns = (
            TextColumn("{task.fields[mark]}", table_column=Column(width=1)), TextColumn("{task.fields[step]:<16}"),
            BarColumn(bar_width=20), TextColumn("{task.fields[state]:>4}"), TimeElapsedColumn(),
            TextColumn("{task.description}", table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")),
        )  # fmt: skip
        self._progress = Progress(*columns, console=self.console, expand=True)
        self._tasks: dict[str, TaskID] = {}
        self._compiles = compiles
        plain = self.console.options.ascii_only
        self._good, self._bad = ("+", "!") if plain else ("[green]✓", "[red]✗")

    def __enter__(self) -> ProgressDisplay:
        if self._compiles and kept_loops() < LOOPS:
            self.console.print("loops are compiled first, once, for a minute or more: the next run is quicker")
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Leave the rows as they are: what is printed from now on stands below them."""
        if self._progress.live.is_started:
            self._progress.stop()

    def __call__(self, event: Event) -> None:
        """Take an event of the runner."""
        step = event.step
        if event.kind in SAID and "text" in event.data:
            self.console.print(str(event.data["text"]), markup=False)
        elif event.kind in ("confirm_needed", "confirmed"):
            tell_question(event, self.console)
        elif step is None:
            return
        elif event.kind == "step_started":
            if (before := self._tasks.pop(step, None)) is not None:
                self._progress.remove_task(before)
            self._show(step, 0.0, "")
        elif event.kind == "progress":
            fraction = event.data["fraction"]
            assert isinstance(fraction, float | int)
            self._show(step, fraction, str(event.data["text"]))
        elif event.kind == "step_done":
            self._show(step, 1.0, "")
            self._progress.stop_task(self._tasks[step])
        elif event.kind == "step_failed":
            self._show(step, None, str(event.data["reason"]))
            self._progress.stop_task(self._tasks[step])

    def _show(self, step: str, fraction: float | None, text: str) -> None:
        """A row at its `fraction`, 1 being done; None: where it is, failed."""
        if step not in self._tasks:
            self._tasks[step] = self._progress.add_task("", total=1.0, step=step, mark=" ", state="")
        mark, state = self._good, "done"
        if fraction is None:
            mark, state = self._bad, "fail"
        elif fraction < 1.0:
            mark, state = " ", f"{100 * fraction:.0f}%"
        self._progress.update(self._tasks[step], completed=fraction, description=escape(text), mark=mark, state=state)

"""Progress bars while a run goes on, and while a first run compiles."""

import getpass
import os
import select
import sys
import termios
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column

from statemachine.control import RunControl
from statemachine.step import Event

SAID = ("note", "paused", "going_on")
"""Kinds of events whose text is shown as it is."""
COMPILE = "compile"
LOOPS = 105
"""About as many loops does a first dry run compile and keep on disk, those of the simulated world among them."""
LOOK_S = 2.0
COMPILED_S = 60.0
"""So long after the last loop was kept nothing more is waited for."""


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


def kept_loops() -> list[float]:
    """When each compiled loop was kept for this Python, in whichever process, seconds since the epoch."""
    here = Path(__file__).parents[3]
    roots = [Path(folder)] if (folder := os.environ.get("NUMBA_CACHE_DIR")) else [here / "cell", here / "sim_backends"]
    times = []
    for index in (path for root in roots for path in root.rglob("*.nbi")):
        if index.name.endswith(f".py{sys.version_info.major}{sys.version_info.minor}.nbi"):
            with suppress(OSError):
                times.append(index.stat().st_mtime)
    return times


class _Unheard(Console):
    """A console that goes quiet once nobody reads it; the library's ends the process, in the middle of a motion."""

    def on_broken_pipe(self) -> None:
        """See `rich.console.Console.on_broken_pipe`."""
        self.quiet = True


class ProgressDisplay:
    """Bars for the steps, a row each; an observer for `Cell.run` and `Cell.calibrate`. Writes to standard error.

    Each row keeps to one line and its bar to its place, however long a text is. With `compiles` a row tells how far
    the loops are compiled, once some are.
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
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._watch_compiler, name="compiler's progress", daemon=True)
        self._compiles = compiles
        # The clock of files lags a little behind.
        self._begun, self._kept = time.time() - 0.05, len(kept_loops()) if compiles else 0
        plain = self.console.options.ascii_only
        self._good, self._bad = ("+", "!") if plain else ("[green]✓", "[red]✗")

    def __enter__(self) -> Self:
        self._progress.start()
        if self._compiles:
            self._watch.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Leave the rows as they are: what is printed from now on stands below them."""
        if self._ended.is_set():
            return
        self._ended.set()
        if self._compiles:
            self._watch.join()
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

    def _watch_compiler(self) -> None:
        """Show what is compiled and kept meanwhile, in whichever process, and how long the rest takes at this pace."""
        made, last = 0, self._begun
        while not self._ended.wait(LOOK_S) and time.time() < last + COMPILED_S:
            now = sum(at > self._begun for at in kept_loops())
            if now == made:
                continue
            if not made and not self.console.is_terminal:
                self.console.print("compiling, once: the next run is quicker")
            made, last = now, time.time()
            total = max(LOOPS - self._kept, made + 1)
            left = (total - made) / made * (last - self._begun)
            words = f"once, about {left:.0f} s left" if self._kept + made < LOOPS else "once"
            self._show(COMPILE, made / total, words)
        if made:
            self._show(COMPILE, 1.0, f"{made} loops, kept")

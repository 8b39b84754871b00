"""Progress bars while a run goes on, the screen at its end, and the tables that are asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from cell.cli.end_screen import duration, end_screen
from cell.config import DEVICES
from cell.report.figures import noise_rows
from statemachine.runner import Event

SAID = ("note", "paused", "going_on")
"""Kinds of events whose text is shown as it is."""

COLOURS = {"placed": "green", "done": "green", "refused": "yellow", "faulted": "red", "aborted": "magenta"}


class _Unheard(Console):
    """A console that goes quiet once nobody reads it; the library's ends the process, in the middle of a motion."""

    def on_broken_pipe(self) -> None:
        """See `rich.console.Console.on_broken_pipe`."""
        self.quiet = True


class ProgressDisplay:
    """Bars for the steps, a row each; an observer for `Cell.run` and `Cell.calibrate`. Writes to standard error."""

    def __init__(self) -> None:
        self.console = _Unheard(stderr=True)
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


def print_report(report: Mapping[str, Any], folder: str, *, noise: bool = False) -> None:
    """The end of a run for people, on one screen; with `noise` the noise that is assumed and the seams below it."""
    console = Console(highlight=False)
    outcome = str(report["outcome"])
    first, *others = end_screen(report, Path(folder), console.width)
    console.print(f"[bold {COLOURS.get(outcome, 'white')}]{outcome}[/]", end="")
    console.print(first.removeprefix(outcome), markup=False, soft_wrap=True)
    for line in others:
        console.print(line, markup=False, soft_wrap=True, style="bold red" if line.startswith("! ") else None)
    if not noise:
        return
    if seams := (report.get("scan") or {}).get("seams"):
        _print_seams(console, seams)
    _print_noise(console, report.get("assumed_noise") or {})


def print_late(report: Mapping[str, Any]) -> None:
    """Say that the program was asked to end when the run had come to its end already. Writes to standard error."""
    part = "the part had been placed" if report["outcome"] == "placed" else f"the run had ended {report['outcome']}"
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    console.print(f"interrupted after {part}", style="bold magenta", markup=False)


def print_runs(rows: Sequence[Mapping[str, Any]]) -> None:
    """A line for each of the rows of `cell.runs.run_row`, its reason cut to the width of the screen."""
    console = Console(highlight=False)
    if not rows:
        console.print("no run yet")
    whats = [" ".join(str(word) for word in (row["kind"], row["job"], _simulated(row)) if word) for row in rows]
    wide = max(map(len, whats), default=0)
    for row, what in zip(rows, whats, strict=True):
        begun = str(row["started"] or "")[:16].replace("T", " ")
        ended = f"{row['outcome']:<10}"
        name = str(row["run"]).split("-")[-1]
        before = f"{begun:<17}{name:<6}{what:<{wide}}  "
        after = f" {duration(row['duration_s']):>6}  {' '.join(str(row['reason'] or '').split())}"
        room = console.width - len(before) - len(ended)
        console.print(before, end="", markup=False)
        console.print(ended, end="", style=COLOURS.get(str(row["outcome"])), markup=False)
        console.print(after if len(after) <= room else after[: room - 2].rstrip() + " …", markup=False, soft_wrap=True)


def _simulated(row: Mapping[str, Any]) -> str:
    which = row.get("simulated")
    if not isinstance(which, list):
        return "(sim)" if which else ""
    real = [name for name in DEVICES if name not in which]
    return f"(sim all but {','.join(real)})" if len(real) < len(which) else f"(sim {','.join(which)})"


def _print_seams(console: Console, seams: Sequence[Mapping[str, Any]]) -> None:
    table = Table(title="how far sweeps lie apart where they overlap, in mm")
    table.add_column("sweeps")
    for name in ("points", "mean", "expected ±", "rms", "expected", "95 % below"):
        table.add_column(name, justify="right")
    for seam in seams:
        values = (seam[f"{key}_mm"] for key in ("mean", "expected_mean", "rms", "expected_rms", "p95"))
        first, second = (str(number + 1) for number in seam["sweeps"])
        table.add_row(f"{first} and {second}", str(seam["points"]), *(f"{value:.4f}" for value in values))
    console.print(table)


def _print_noise(console: Console, noise: Mapping[str, Any]) -> None:
    table = Table(title=f"assumed noise, 1 sigma (level {noise.get('level')})")
    table.add_column("of")
    table.add_column("sigma", justify="right")
    table.add_column("unit")
    for row in noise_rows(noise):
        table.add_row(*row)
    console.print(table)


def print_calibration(summary: Mapping[str, Any], where: str | None) -> None:
    """A calibration for people: values with their standard deviations, then how well the observations fit."""
    console = Console()
    lens, plane, rail, hand = (summary[key] for key in ("scan_camera", "light_plane", "rail", "hand_eye"))
    values = Table(title=f"calibration of {summary['date']}")
    values.add_column("quantity")
    values.add_column("value", justify="right")
    values.add_column("sigma", justify="right")
    values.add_column("unit")
    for name, unit in (("fx", "px"), ("fy", "px"), ("cx", "px"), ("cy", "px"), ("k1", "")):
        values.add_row(f"scan camera {name}", f"{lens[name]:.4f}", f"{lens[f'sigma_{name}']:.4f}", unit)
    values.add_row("light plane distance", f"{plane['distance_mm']:.4f}", f"{plane['sigma_distance_mm']:.4f}", "mm")
    values.add_row("rail scale", f"{rail['scale']:.6f}", f"{rail['sigma_scale']:.6f}", "")
    for axis, value, sigma in zip("xyz", hand["translation_mm"], hand["sigma_mm"], strict=True):
        values.add_row(f"flange to scan camera {axis}", f"{value:.4f}", f"{sigma:.4f}", "mm")
    for axis, sigma in zip("xyz", hand["sigma_mrad"], strict=True):
        values.add_row(f"turn about flange {axis}", "", f"{sigma:.4f}", "mrad")
    if (since := summary["laser_since"]) is not None:
        turned = f"laser turned since, verified {since['date']}"
        values.add_row(turned, f"{since['turned_mrad']:+.4f}", f"{since['sigma_mrad']:.4f}", "mrad")
    if (timing := summary["timing"]) is not None:
        late = f"time stamps late, measured {timing['date']}"
        values.add_row(late, f"{timing['late_ms']:+.4f}", f"{timing['sigma_ms']:.4f}", "ms")
    if (shutter := summary["shutter"]) is not None:
        values.add_row("last row after the first", f"{shutter['readout_ms']:+.4f}", f"{shutter['sigma_ms']:.4f}", "ms")
    console.print(values)
    fit = Table(title="residuals; held-out views are predicted from the others")
    for name in ("camera", "views", "chi²/dof", "dots px", "held-out px", "stripe mm", "held-out mm"):
        fit.add_column(name, justify="left" if name == "camera" else "right")
    for camera in ("scan", "target"):
        q = summary[f"{camera}_quality"]
        keys = ("dots_rms_px", "held_out_dots_rms_px", "stripe_rms_mm", "held_out_stripe_rms_mm")
        shown = ["" if q.get(key) is None else f"{q[key]:.4f}" for key in keys]
        fit.add_row(camera, str(q["views"]), f"{q['chi2_per_dof']:.3f}", *shown)
    console.print(fit)
    for note in summary["notes"]:
        console.print(note, markup=False, soft_wrap=True)
    if where is not None:
        console.print(f"stored in {where}", markup=False, soft_wrap=True)

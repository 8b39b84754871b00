"""Progress bars while a run goes on and the table at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from cell.report.paper import TABLE_1_HANDSCAN, TABLE_1_OPTIMISED
from statemachine.runner import Event

SHOWN_UNITS = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "rad/m": (1e3, "mrad/m"), "s": (1e6, "us")}
"""How a standard deviation in SI is shown to people, by its unit."""

COLOURS = {"placed": "green", "refused": "yellow", "faulted": "red", "aborted": "magenta"}


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
        if event.kind == "note" and "text" in event.data:
            self.console.print(str(event.data["text"]), markup=False)
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


def print_report(report: Mapping[str, Any], folder: str) -> None:
    """The end of a run for people: outcome, steps, place error beside the paper's Table 1 and the expected bound."""
    console = Console()
    outcome = str(report["outcome"])
    console.print(f"[bold {COLOURS.get(outcome, 'white')}]{outcome}[/]", end=" ")
    console.print(str(report["reason"]), markup=False, soft_wrap=True)
    steps = Table(title="steps")
    for name, right in (("step", False), ("state", False), ("duration in s", True), ("retries", True)):
        steps.add_column(name, justify="right" if right else "left")
    for row in report["steps"]:
        duration = row.get("duration_s")
        shown = "" if duration is None else f"{duration:.2f}"
        steps.add_row(row["name"], row["state"], shown, str(row.get("retries", "")))
    console.print(steps)
    if seams := (report.get("scan") or {}).get("seams"):
        _print_seams(console, seams)
    if (truth := report.get("truth")) is not None:
        _print_error(console, truth)
        _print_noise(console, report["assumed_noise"])
    console.print(f"run folder: {folder}", markup=False, soft_wrap=True)


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


def _print_error(console: Console, truth: Mapping[str, Any]) -> None:
    table = Table(
        title=f"place error over {truth['points']} points in mm (simulated; the paper's figures are hardware)"
    )
    table.add_column("axis")
    for source in ("this run", "paper, optimised", "paper, Handscan"):
        table.add_column(f"{source}: mean", justify="right")
        table.add_column("max", justify="right")
    for axis in ("x", "y", "z", "d"):
        own = truth["error_mm"][axis]
        paper, scan = TABLE_1_OPTIMISED[axis], TABLE_1_HANDSCAN[axis]
        values = (own["mean"], own["max"], *paper, *scan)
        table.add_row(axis.upper() if axis == "d" else axis, *(f"{value:.4f}" for value in values))
    console.print(table)
    sensor = truth.get("sensor_mm")
    console.print(
        f"expected mean D for the assumed noise: {truth['bound_mm']:.4f} mm · D at 95 %: {truth['d_p95']:.4f} mm"
        + ("" if sensor is None else f" · cloud: mean {sensor['mean']:.4f} mm, 85 % below {sensor['p85']:.4f} mm")
    )
    console.print("Table 1 as printed; its largest D is more than its largest x, y and z allow together (1.795 mm).")


def _print_noise(console: Console, noise: Mapping[str, Any]) -> None:
    table = Table(title=f"assumed noise, 1 sigma (level {noise.get('level')})")
    table.add_column("of")
    table.add_column("sigma", justify="right")
    table.add_column("unit")
    for entry in noise.get("sigmas", {}).values():
        factor, unit = SHOWN_UNITS.get(entry["unit"], (1.0, entry["unit"]))
        table.add_row(str(entry["of"]), f"{factor * entry['sigma']:.4g}", str(unit))
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
    if where is not None:
        console.print(f"stored in {where}", markup=False, soft_wrap=True)

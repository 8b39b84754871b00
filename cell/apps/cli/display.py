"""The screen at the end of a run, and the tables that are asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from cell.apps.cli.end_screen import duration, end_screen
from cell.apps.cli.options import new_table
from cell.config.files import DEVICES
from cell.run.report.figures import noise_rows

COLOURS = {"placed": "green", "done": "green", "refused": "yellow", "faulted": "red", "aborted": "magenta"}


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
    columns = ("sweeps", ">points", ">mean", ">expected ±", ">rms", ">expected", ">95 % below")
    table = new_table("how far sweeps lie apart where they overlap, in mm", *columns)
    for seam in seams:
        values = (seam[f"{key}_mm"] for key in ("mean", "expected_mean", "rms", "expected_rms", "p95"))
        first, second = (str(number + 1) for number in seam["sweeps"])
        table.add_row(f"{first} and {second}", str(seam["points"]), *(f"{value:.4f}" for value in values))
    console.print(table)


def _print_noise(console: Console, noise: Mapping[str, Any]) -> None:
    table = new_table(f"assumed noise, 1 sigma (level {noise.get('level')})", "of", ">sigma", "unit")
    for row in noise_rows(noise):
        table.add_row(*row)
    console.print(table)


def print_calibration(summary: Mapping[str, Any], where: str | None) -> None:
    """A calibration for people: values with their standard deviations, then how well the observations fit."""
    console = Console()
    lens, plane, rail, hand = (summary[key] for key in ("scan_camera", "light_plane", "rail", "hand_eye"))
    values = new_table(f"calibration of {summary['date']}", "quantity", ">value", ">sigma", "unit")
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
    columns = (">views", ">chi²/dof", ">dots px", ">held-out px", ">stripe mm", ">held-out mm")
    fit = new_table("residuals; held-out views are predicted from the others", "camera", *columns)
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

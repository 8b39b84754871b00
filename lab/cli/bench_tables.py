"""The accuracy campaign for people: errors beside bounds, limits and the paper's figures, outcomes, assumed noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from cell.run.report.figures import noise_rows
from cell.run.report.report import TABLE_1_HANDSCAN, TABLE_1_OPTIMISED
from lab.cli.paper_tables import print_acceptance
from lab.cli.shown import empty, table

_ROWS = (
    ("sensor, scan frame, mean", "mm", "sensor_scan_mm", "mean"),
    ("sensor, scan frame, 85 %", "mm", "sensor_scan_mm", "p85"),
    ("arm's own base, 45 points, mean", "mm", "arm_base_mm", "mean"),
    ("arm's own base, 45 points, max", "mm", "arm_base_mm", "max"),
    ("true base, 45 points, mean", "mm", "arm_base_mm", "absolute_mean"),
    ("placement, 45 points, mean", "mm", "placement_mm", "mean"),
    ("placement, 45 points, 95 %", "mm", "placement_mm", "p95"),
    ("tilt of the part, max", "mrad", "tilt_mrad", "max"),
)
_PAPER = {
    ("placement_mm", "mean"): f"{TABLE_1_OPTIMISED['d'][0]:.3f} ({TABLE_1_HANDSCAN['d'][0]:.3f})",
    ("sensor_scan_mm", "p85"): "0.54",
}


def print_accuracy(result: Mapping[str, Any]) -> None:
    """One table a level, then what was assumed."""
    console = Console()
    for level, figures in result["levels"].items():
        _errors(console, level, figures)
        _outcomes(console, figures)
        print_acceptance(figures["acceptance"])
        _noise(console, level, figures["assumed_noise"])
    console.print(
        "Simulated, with the noise above; the paper's figures are its own hardware's, Table 1 as printed (the "
        "hand-held scanner's in brackets).",
        soft_wrap=True,
    )


def _errors(console: Console, level: str, figures: Mapping[str, Any]) -> None:
    columns = ("D = distance from the truth", "measured", "expected", "limit", "paper", "<unit")
    shown = empty(f"level {level}, {figures['runs']} runs", *columns)
    limits = figures.get("limits", {})
    for text, unit, key, name in _ROWS:
        bound = figures[key].get("absolute_bound" if name == "absolute_mean" else "bound")
        expected = _shown(bound) if name.endswith("mean") else ""
        limit = limits.get(key, {}).get(name)
        shown.add_row(text, _shown(figures[key][name]), expected, _shown(limit), _PAPER.get((key, name), ""), unit)
    covered = limits.get("coverage_95")
    allowed = "" if covered is None else f"{100 * covered['low']:.0f}–{100 * covered['high']:.0f}"
    share = figures["coverage_95"]
    shown.add_row("in the stated 95 % ellipsoid", "" if share is None else f"{100 * share:.1f}", "95", allowed, "", "%")
    for name, value in figures["chi2_per_dof"].items():
        shown.add_row(f"χ²/dof, {name}", _shown(value), "1", "", "", "")
    console.print(shown)


def _outcomes(console: Console, figures: Mapping[str, Any]) -> None:
    outcomes = figures["outcomes"]
    console.print(
        f"placed within tolerance {outcomes['placed_within_tolerance']}, outside "
        f"{outcomes['placed_outside_tolerance']}, refused {outcomes['refused']}, faulted {outcomes['faulted']}"
    )
    for reason, count in outcomes["reasons"].items():
        console.print(f"  {count} times {reason}", markup=False, soft_wrap=True)


def _noise(console: Console, level: str, noise: Mapping[str, Any]) -> None:
    rows = noise_rows({"sigmas": noise})
    console.print(table(f"assumed noise, 1 sigma (level {level})", ("of", "sigma", "<unit"), rows))


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"

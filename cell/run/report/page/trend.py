"""How a run stands among the runs of the same job before it, as an inline SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from cell.run.folder import list_runs, read_report
from drivers.errors import CellError

MOST = 30
"""Runs that are shown, the newest."""
WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 900, 230, 60, 44, 16
TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class Past:
    """A run of the job: its largest true place error where that is known, and what it states, in mm."""

    name: str
    started: str
    outcome: str
    simulated: bool
    true_mm: float | None
    stated_mm: float | None


def past_runs(folder: Path, report: Mapping[str, Any]) -> list[Past]:
    """The runs of the same job beside `folder` that began before it, and itself at the end; what cannot be read is left
    out."""
    found = []
    names = [run for run in list_runs(folder.parent) if run.name < folder.name]
    for run in reversed(names):
        try:
            told = read_report(run)
        except (CellError, OSError):
            continue
        if told.get("kind", "job") == "job" and told.get("job") == report.get("job"):
            found.append(_past(run.name, told))
        if len(found) == MOST - 1:
            break
    return [*reversed(found), _past(folder.name, report)]


def _past(name: str, report: Mapping[str, Any]) -> Past:
    truth, bound = report.get("truth"), report.get("place_bound_95")
    return Past(
        name,
        str(report.get("started") or "")[:16].replace("T", " "),
        str(report["outcome"]),
        simulated=bool(report.get("simulated")),
        true_mm=None if truth is None else float(truth["error_mm"]["d"]["max"]),
        stated_mm=None if bound is None else float(bound["d"]),
    )


def trend_svg(runs: Sequence[Past], tolerance_mm: float | None) -> str:
    """The drawing: filled dots for the true error, rings for the stated bound, crosses for runs without either."""
    values = [value for run in runs for value in (run.true_mm, run.stated_mm) if value is not None]
    most = 1.1 * max([*values, tolerance_mm or 0.0, 1e-3])
    low = HEIGHT - BOTTOM
    apart = (WIDTH - LEFT - 20) / max(1, len(runs))

    def level(value: float) -> float:
        return low - (low - TOP) * min(value / most, 1.0)

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="place error over the runs">']
    tick = next((tick for tick in TICKS if most / tick <= 6), most / 4)
    for value in (k * tick for k in range(int(most / tick) + 1)):
        y = level(value)
        parts.append(f'<line x1="{LEFT}" y1="{y:.1f}" x2="{WIDTH - 10}" y2="{y:.1f}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>')
    parts.append(f'<text x="2" y="{0.5 * (low + TOP):.0f}">mm</text>')
    if tolerance_mm is not None:
        y = level(tolerance_mm)
        parts.append(
            f'<line x1="{LEFT}" y1="{y:.1f}" x2="{WIDTH - 10}" y2="{y:.1f}" stroke="#c0392b" stroke-dasharray="6 4"/>'
            f'<text x="{WIDTH - 12}" y="{y - 5:.1f}" text-anchor="end" fill="#c0392b">tolerance {tolerance_mm:g} mm'
            "</text>"
        )
    for k, run in enumerate(runs):
        x = LEFT + apart * (k + 0.5)
        told = f"<title>{escape(_words(run))}</title>"
        if run.stated_mm is not None:
            y = level(run.stated_mm)
            parts.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="none" stroke="#d07000" stroke-width="2">{told}</circle>'
            )
        if run.true_mm is not None:
            parts.append(f'<circle cx="{x:.1f}" cy="{level(run.true_mm):.1f}" r="5" fill="#2c5f9e">{told}</circle>')
        if run.stated_mm is None and run.true_mm is None:
            parts.append(f'<text x="{x:.1f}" y="{low - 4}" text-anchor="middle" fill="#c0392b">✕{told}</text>')
        weight = ' font-weight="bold"' if k == len(runs) - 1 else ""
        if len(runs) <= 15 or k % 3 == (len(runs) - 1) % 3:
            parts.append(
                f'<text x="{x:.1f}" y="{low + 16}" text-anchor="middle"{weight}>{escape(run.name[-4:])}</text>'
            )
            parts.append(f'<text x="{x:.1f}" y="{low + 31}" text-anchor="middle">{escape(run.outcome)}</text>')
    return "".join([*parts, "</svg>"])


def _words(run: Past) -> str:
    true = "" if run.true_mm is None else f", true error {run.true_mm:.3f} mm"
    stated = "" if run.stated_mm is None else f", stated {run.stated_mm:.3f} mm"
    return f"{run.name}, {run.started}, {run.outcome}{true}{stated}{', simulated' if run.simulated else ''}"

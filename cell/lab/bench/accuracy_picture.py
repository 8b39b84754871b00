"""The picture of an accuracy campaign: every run's mean errors by seed, beside what the declared noise lets expect."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

_PANELS = (
    ("scan", "sensor, scan frame", "sensor_scan_mm"),
    ("own", "45 points, arm's own base", "arm_base_mm"),
    ("placement", "placement, 45 points", "placement_mm"),
)


def draw(path: Path, result: Mapping[str, Any]) -> None:
    """Write a PNG: a column of panels for each quantity, a row a level; mean D of each run in mm."""
    levels = result["levels"]
    figure = Figure(figsize=(13, 3.4 * len(levels) + 0.4), dpi=110, layout="constrained")
    figure.suptitle(f"accuracy campaign, job {result['job']} (simulated)")
    grid = figure.subplots(len(levels), len(_PANELS), squeeze=False)
    for row, (level, figures) in zip(grid, levels.items(), strict=True):
        for axes, (name, title, key) in zip(row, _PANELS, strict=True):
            runs = [run for run in figures["per_run"] if name in run]
            axes.set_title(f"{title}, level {level}")
            axes.bar(
                [run["seed"] for run in runs], [run[name] for run in runs], color="tab:blue", label="mean D of a run"
            )
            if figures[key]["bound"] is not None:
                axes.axhline(figures[key]["bound"], color="tab:green", linestyle="--", label="expected mean D")
            if (limit := figures.get("limits", {}).get(key, {}).get("mean")) is not None:
                axes.axhline(limit, color="tab:red", linestyle=":", label="limit of the mean")
            lost = [run["seed"] for run in figures["per_run"] if name not in run]
            axes.plot(lost, [0.0] * len(lost), "x", color="tab:red", label="not reached" if lost else None)
            axes.set_xlabel("seed")
            axes.set_ylabel("mm")
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    figure.savefig(path)

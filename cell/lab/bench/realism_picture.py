"""The picture of `cell bench realism`: a bar of verdicts for each effect, and its errors beside."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

VERDICTS = {"inside": "tab:green", "named": "tab:blue", "refused": "tab:gray", "outside": "tab:red"}


def draw(path: Path, result: Mapping[str, Any]) -> None:
    """Write a PNG: for each effect the worlds by verdict, and each world's placement error in mm."""
    names = list(result["effects"])
    figure = Figure(figsize=(12, 0.4 * len(names) + 1.6), dpi=110, layout="constrained")
    figure.suptitle(f"the workshop's effects, job {result['job']} (simulated)")
    left, right = figure.subplots(1, 2, sharey=True)
    for row, name in enumerate(names):
        entry, begin = result["effects"][name], 0
        for verdict, colour in VERDICTS.items():
            left.barh(row, entry[verdict], left=begin, color=colour, label=verdict if row == 0 else None)
            begin += entry[verdict]
        placed = [run["placement_mm"] for run in entry["runs"] if run["placement_mm"] is not None]
        right.plot(placed, [row] * len(placed), "o", markersize=4, alpha=0.6, color="tab:blue")
    left.set_yticks(range(len(names)), names)
    left.invert_yaxis()
    left.set_xlabel("worlds")
    left.legend(loc="lower left", fontsize=7, ncols=len(VERDICTS))
    right.set_xlabel("placement, mean of 45 points, mm")
    right.set_xlim(left=0.0)
    figure.savefig(path)

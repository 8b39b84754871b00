"""The picture of Table 1: its means as bars beside the paper's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

SERIES = (
    ("nominal", "before: as drawn (simulated)", "tab:orange"),
    ("staged", "after: the paper's steps (simulated)", "tab:cyan"),
    ("joint", "after: joint adjustment (simulated)", "tab:blue"),
)
PAPER_SERIES = (
    ("optimised", "paper, optimised (its hardware)", "tab:gray"),
    ("handscan", "paper, Handscan (its hardware)", "silver"),
)


def draw_table1(result: Mapping[str, Any], path: Path) -> Path:
    """Table 1: mean as bars, whiskers to the largest, logarithmic."""
    figure = Figure(figsize=(10, 5.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    series = [(label, result["table_1"][key], colour) for key, label, colour in SERIES]
    series += [(label, result["paper"]["table_1"][key], colour) for key, label, colour in PAPER_SERIES]
    places = np.arange(4)
    for k, (label, table, colour) in enumerate(series):
        mean = np.array([table[axis]["mean"] for axis in "xyzd"])
        top = np.array([table[axis]["max"] for axis in "xyzd"])
        at = places + 0.16 * (k - 2)
        axes.bar(at, mean, 0.15, color=colour, label=label)
        axes.errorbar(at, mean, yerr=[np.zeros(4), top - mean], fmt="none", ecolor="black", capsize=3)
    bound = result["bound_arm_base_mm"]
    axes.hlines(bound, 2.5, 3.5, color="tab:green", linestyle="--", label=f"expected mean D, {bound:.3f} mm")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(places, ["X", "Y", "Z", "D"])
    axes.set_ylabel("deviation in mm (log): mean, whisker to the largest")
    noise = result["assumed_noise"]
    axes.set_title(
        f"45 points in 5 segments, arm base, {result['seeds']} simulated heads beside the paper's Table 1\n"
        f"assumed noise, 1σ: stripe {noise['stripe_px']:g} px, dots {noise['dots_px']:g} px, rail {noise['rail_mm']:g} "
        f"mm, arm {noise['arm_mm_radial']:g} mm and {noise['arm_mrad_per_axis']:g} mrad",
        fontsize=10,
    )
    figure.legend(*axes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=3)
    figure.savefig(path)
    return path

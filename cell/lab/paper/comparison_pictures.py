"""Pictures of the comparisons: Table 1 as bars beside the paper's, and the cited systems' figures beside ours."""

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


def draw_systems(result: Mapping[str, Any], path: Path) -> Path:
    """Theirs and ours for each system, logarithmic."""
    figure = Figure(figsize=(11, 5.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    rows = result["systems"]
    places = np.arange(len(rows))
    expected = [row["ours"]["expected_mean_mm"] for row in rows]
    series = (
        ([row["theirs"]["mm"] for row in rows], "theirs, as published (hardware)", "tab:gray"),
        ([row["ours"]["p95_mm"] for row in rows], "ours, 95 % of the points below (simulated)", "tab:blue"),
        ([row["ours"]["mean_mm"] for row in rows], "ours, mean (simulated)", "tab:cyan"),
    )
    for k, (values, label, colour) in enumerate(series):
        axes.bar(places + 0.27 * (k - 1), values, 0.25, color=colour, label=label)
        # The number stands clear of the expected mean's line, which is drawn over the last bars.
        tops = np.maximum(values, expected) if k == 2 else values
        for place, value, top in zip(places, values, tops, strict=True):
            axes.annotate(f"{value:.3g}", (place + 0.27 * (k - 1), top), (0, 3), textcoords="offset points",
                          fontsize=8, ha="center", va="bottom")  # fmt: skip
    axes.plot(places + 0.27, expected, "_", color="tab:green", markersize=26, markeredgewidth=2,
              label="expected mean for the assumed noise")  # fmt: skip
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(places, [f"{row['system']} {row['reference']}\n{row['theirs']['headline']}" for row in rows],
                    fontsize=7.5)  # fmt: skip
    axes.set_ylabel("error in mm (log)")
    axes.set_title("Systems that the paper cites: theirs measured on hardware, ours simulated")
    figure.legend(*axes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=2)
    figure.savefig(path)
    return path

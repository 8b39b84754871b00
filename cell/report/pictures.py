"""The picture of a run: a stripe frame, the cloud coloured by its deviation, and the place error as bars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cell.report.paper import TABLE_1_HANDSCAN, TABLE_1_OPTIMISED
from drivers.interfaces import Image, Vector

MAX_POINTS = 40_000


def run_picture(
    path: Path,
    *,
    stripe: tuple[Image, Vector, Vector] | None,
    cloud: tuple[Vector, Vector] | None,
    truth: dict[str, Any] | None,
    title: str,
    seams: Sequence[dict[str, Any]] = (),
) -> None:
    """Draw what a run has: parts that it did not get to are left out, with a word in their place.

    `stripe` is a frame with the rows and the centres in px of its stripe; `cloud` is points (n, 3) in the surface's
    frame in m with their signed deviations (n,) from the nominal surface in m; `truth` and `seams` are the report's
    parts of these names.
    """
    figure = Figure(figsize=(16, 5.2), dpi=110, layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(1, 3, width_ratios=[1.15, 1.25, 1.0])
    _stripe(axes[0], stripe)
    _cloud(figure, axes[1], cloud, seams)
    _bars(axes[2], truth)
    figure.savefig(path)


def _stripe(axes: Axes, stripe: tuple[Image, Vector, Vector] | None) -> None:
    axes.set_title("stripe in the middle of the sweep")
    if stripe is None:
        _empty(axes, "no sweep")
        return
    image, rows, centres = stripe
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    axes.plot(centres, rows, ",", color="tab:red")
    axes.set_xlabel("column in px")
    axes.set_ylabel("row in px")


def _cloud(figure: Figure, axes: Axes, cloud: tuple[Vector, Vector] | None, seams: Sequence[dict[str, Any]]) -> None:
    told = [seam_words(seam) for seam in seams]
    axes.set_title("\n".join(["cloud, coloured by its deviation from the nominal surface", *told]), fontsize="medium")
    if cloud is None or len(cloud[0]) == 0:
        _empty(axes, "no cloud")
        return
    points, deviation = cloud
    chosen = np.linspace(0, len(points) - 1, min(MAX_POINTS, len(points))).astype(int)
    span = max(0.02, float(np.percentile(np.abs(deviation), 98)) * 1e3)
    shown = axes.scatter(
        points[chosen, 0] * 1e3, points[chosen, 1] * 1e3, c=deviation[chosen] * 1e3, s=1, cmap="coolwarm",
        vmin=-span, vmax=span, linewidths=0,
    )  # fmt: skip
    axes.set_aspect("equal")
    axes.set_xlabel("x along the sweep in mm")
    axes.set_ylabel("y in mm")
    figure.colorbar(shown, ax=axes, label="deviation in mm", shrink=0.8)


def seam_words(seam: dict[str, Any]) -> str:
    """One of the report's seams in a line."""
    first, second = (number + 1 for number in seam["sweeps"])
    return (
        f"sweep {second} on sweep {first}: mean {seam['mean_mm']:+.3f} mm (expected ± {seam['expected_mean_mm']:.3f}), "
        f"rms {seam['rms_mm']:.3f} mm (expected {seam['expected_rms_mm']:.3f})"
    )


def _bars(axes: Axes, truth: dict[str, Any] | None) -> None:
    axes.set_title("place error over 45 points")
    if truth is None:
        _empty(axes, "no truth: real devices, or nothing placed")
        return
    names = ["x", "y", "z", "d"]
    places = np.arange(len(names))
    own = [truth["error_mm"][name] for name in names]
    rows = [
        ("this run (simulated)", [(entry["mean"], entry["max"]) for entry in own], "tab:blue"),
        ("paper, optimised (its hardware)", [TABLE_1_OPTIMISED[name] for name in names], "tab:gray"),
        ("paper, Handscan (its hardware)", [TABLE_1_HANDSCAN[name] for name in names], "silver"),
    ]
    for k, (label, values, colour) in enumerate(rows):
        mean = np.array([value[0] for value in values])
        top = np.array([value[1] for value in values])
        axes.bar(places + 0.27 * (k - 1), mean, 0.25, color=colour, label=label)
        axes.errorbar(
            places + 0.27 * (k - 1), mean, yerr=[np.zeros(4), top - mean], fmt="none", ecolor="black", capsize=3
        )
    axes.axhline(
        truth["bound_mm"], color="tab:green", linestyle="--", label=f"expected mean D {truth['bound_mm']:.3f} mm"
    )
    axes.set_yscale("log")
    axes.set_xticks(places, ["x", "y", "z", "D"])
    axes.set_ylabel("mean, whisker to max, in mm (log)")
    axes.set_ylim(bottom=0.004)
    axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2)


def _empty(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
    axes.set_axis_off()

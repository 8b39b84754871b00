"""The picture of Figure 2: error maps for 30 and 35 mm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from lab.paper.design import HALF_SENSOR, Head, errors
from lab.paper.figure2 import BASELINES, DELTA, FOCAL

LEVELS_MM = (0.02, 0.05, 0.1, 0.2)


def draw(path: Path) -> None:
    """|dX|, |dY|, |dZ| over the sensor, a row for each baseline, all on one colour scale, as an image file."""
    figure = Figure(figsize=(13.5, 8.2), dpi=110, layout="constrained")
    figure.suptitle(
        f"Error over the sensor: f = {1e3 * FOCAL:g} mm, light plane meets the axis at 150 mm, "
        f"stripe error {1e6 * DELTA:.2f} µm (0.1 px of 4.8 µm)"
    )
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    side = np.linspace(-HALF_SENSOR, HALF_SENSOR, 201)
    found = [errors(Head.at_stand_off(b, FOCAL), side[None, :], side[:, None], DELTA) for b in BASELINES]
    top = 1e3 * max(float(maps[name].max()) for maps in found for name in ("dx", "dy", "dz"))
    shown = None
    for row, (baseline, maps) in enumerate(zip(BASELINES, found, strict=True)):
        for column, name in enumerate(("dx", "dy", "dz")):
            place = axes[row, column]
            values = 1e3 * maps[name]
            shown = place.imshow(
                values, extent=(-1, 1, -1, 1), origin="lower", cmap="viridis", norm=LogNorm(2e-3, top), aspect="equal"
            )
            lines = place.contour(1e3 * side, 1e3 * side, values, levels=LEVELS_MM, colors="white", linewidths=0.9)
            place.clabel(lines, fmt="%g mm", fontsize=8)
            place.set_title(f"|d{name[1].upper()}|, l = {1e3 * baseline:g} mm: largest {values.max():.3f} mm")
            place.set_xticks([-1, -0.5, 0, 0.5, 1])
            place.set_yticks([-1, -0.5, 0, 0.5, 1])
            if row == 1:
                place.set_xlabel("x' across the stripe in mm")
            if column == 0:
                place.set_ylabel("y' along the stripe in mm")
    assert shown is not None
    ticks = [t for t in (0.002, 0.005, 0.01, *LEVELS_MM, 0.5) if t <= top]
    bar = figure.colorbar(shown, ax=axes, label="largest error in mm for stripe errors of ±δ (log)", shrink=0.85)
    bar.set_ticks(ticks, labels=[f"{t:g}" for t in ticks])
    figure.savefig(path)

"""The pictures of Figure 2: error maps for 30 and 35 mm, and what the choice of the baseline rests on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from cell.lab.paper.design import HALF_SENSOR, PIXEL, Head, Light, errors, largest_dz, peak_power, uniformity
from cell.lab.paper.figure2 import BASELINES, DELTA, DEMAND, FOCAL, GRID

LEVELS_MM = (0.02, 0.05, 0.1, 0.2)


def draw(folder: Path) -> list[Path]:
    """Write `figure2_errors.png` and `figure2_choice.png` into the folder; their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    return [_error_maps(folder / "figure2_errors.png"), _choice(folder / "figure2_choice.png")]


def _error_maps(path: Path) -> Path:
    """|dX|, |dY|, |dZ| over the sensor, a row for each baseline, all on one colour scale."""
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
    return path


def _choice(path: Path) -> Path:
    """Largest error, light over the sensor, and evenness and depth range, each against the baseline."""
    figure = Figure(figsize=(16, 5.0), dpi=110, layout="constrained")
    figure.suptitle("What chooses the baseline (f = 8 mm, stand-off 150 mm, |x'| ≤ 1 mm)")
    axes = figure.subplots(1, 3)
    _errors_by_baseline(axes[0])
    _light(axes[1])
    _range(axes[2])
    figure.savefig(path)
    return path


def _errors_by_baseline(axes: Axes) -> None:
    fine = np.linspace(0.022, 0.08, 300)
    for share, colour in ((0.06, "tab:green"), (0.1, "tab:blue"), (0.15, "tab:orange")):
        delta = share * PIXEL
        axes.plot(
            1e3 * fine,
            [1e3 * largest_dz(Head.at_stand_off(float(b), FOCAL), delta) for b in fine],
            color=colour,
            label=f"δ = {1e6 * delta:.2f} µm ({share:g} px)",
        )
        grid = np.array([b for b in GRID if b >= fine[0]])
        axes.plot(
            1e3 * grid, [1e3 * largest_dz(Head.at_stand_off(float(b), FOCAL), delta) for b in grid], "o",
            color=colour, markersize=4,
        )  # fmt: skip
    axes.axhline(1e3 * DEMAND, color="black", linestyle="--", linewidth=1, label="0.2 mm")
    axes.axvline(35, color="gray", linestyle=":", linewidth=1)
    axes.set_yscale("log")
    axes.set_ylim(0.03, 3)
    axes.set_yticks([0.05, 0.1, 0.2, 0.5, 1, 2], ["0.05", "0.1", "0.2", "0.5", "1", "2"])
    axes.set_title("largest |dZ|: 35 mm is the first of the 5 mm grid below 0.2 mm at 0.1 px", fontsize=9)
    axes.set_xlabel("baseline in mm (dots: 5 mm grid)")
    axes.set_ylabel("largest |dZ| in mm (log)")
    axes.legend(fontsize=8)


def _light(axes: Axes) -> None:
    x = np.linspace(-HALF_SENSOR, HALF_SENSOR, 201)
    light = Light()
    for baseline in (0.020, 0.030, 0.035, 0.050, 0.080):
        head = Head.at_stand_off(baseline, FOCAL)
        axes.plot(
            1e3 * x,
            1e12 * peak_power(head, x, light),
            label=f"l = {1e3 * baseline:g} mm: min/max {uniformity(head, light):.2f}",
        )
    axes.set_title(
        f"energy on the sensor: nearly the same in the middle, less even for short baselines\n(laser "
        f"{1e3 * light.power:g} mW over {np.degrees(light.fan):.0f}°, f/{light.f_number:g}, albedo {light.albedo:g})",
        fontsize=9,
    )
    axes.set_xlabel("x' across the stripe in mm")
    axes.set_ylabel("power in the brightest pixel of a row in pW")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8)


def _range(axes: Axes) -> None:
    grid = np.array(GRID)
    heads = [Head.at_stand_off(float(b), FOCAL) for b in grid]
    near, far = (1e3 * np.array([head.usable_depth()[k] for head in heads]) for k in (0, 1))
    axes.fill_between(1e3 * grid, near, np.minimum(far, 620), color="tab:blue", alpha=0.2, label="depths within ±1 mm")
    axes.plot(1e3 * grid, near, "o-", color="tab:blue", markersize=3)
    axes.plot(1e3 * grid, far, "o-", color="tab:blue", markersize=3)
    axes.axhline(150, color="gray", linestyle=":", linewidth=1, label="stand-off")
    axes.set_ylim(0, 600)
    axes.set_title("depth range and evenness of the light", fontsize=9)
    axes.set_xlabel("baseline in mm")
    axes.set_ylabel("depth Z in mm")
    even = axes.twinx()
    even.plot(1e3 * grid, [uniformity(h, Light()) for h in heads], "s-", color="tab:red", markersize=3)
    even.set_ylabel("smallest / largest power over ±1 mm", color="tab:red")
    even.set_ylim(0, 0.6)
    axes.legend(fontsize=8, loc="upper right")

"""Figure 2 in numbers: what 30 and 35 mm of baseline give, which rule chooses 35 mm, and where the paper is wrong.

docs/explanation/theory.md, section 3; the functions behind it are in `design`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lab.paper.design import (
    HALF_SENSOR,
    PIXEL,
    STAND_OFF,
    TAN_THETA,
    Head,
    Light,
    delta_limit,
    errors,
    largest_dz,
    peak_power,
    uniformity,
)

FOCAL = 8e-3
DELTA = 0.1 * PIXEL
"""The stripe error that the maps are drawn for: a tenth of a pixel, m."""
BASELINES = (0.030, 0.035)
CLAIMS = ((0.030, 0.5e-3), (0.035, 0.2e-3))
"""Baseline and largest error that the paper states for it, m."""
FOCALS = (6.54e-3, 8e-3, 12e-3, 16e-3)
GRID = tuple(round(0.005 * k, 3) for k in range(4, 17))
"""Baselines on a 5 mm grid, m."""
DEMAND = 0.2e-3
STRUCTURE_CLAIM = 0.1e-3
LEVELS_MM = (0.02, 0.05, 0.1, 0.2)


def smallest_baseline(delta: float, demand: float = DEMAND) -> float | None:
    """The smallest baseline in m on the 5 mm grid that keeps |dZ| ≤ `demand` m at a stripe error of `delta` m."""
    for baseline in GRID:
        if delta_limit(Head.at_stand_off(baseline, FOCAL), demand) >= delta:
            return baseline
    return None


def figure2() -> dict[str, Any]:
    """Every number of the study as plain data; lengths in mm or µm as their names say, angles in degrees."""
    light = Light()
    one_apart = Head.at_stand_off(GRID[GRID.index(0.035) - 1], FOCAL)
    return {
        "note": "computed from the corrected equations; the paper states neither its stripe error nor its focal length",
        "assumed": {
            "focal_mm": 1e3 * FOCAL,
            "half_sensor_mm": 1e3 * HALF_SENSOR,
            "stand_off_mm": 1e3 * STAND_OFF,
            "stripe_error_um": 1e6 * DELTA,
            "pixel_um": 1e6 * PIXEL,
            "laser_mw": 1e3 * light.power,
            "fan_deg": round(float(np.degrees(light.fan)), 6),
            "f_number": light.f_number,
            "albedo": light.albedo,
            "transmission": light.transmission,
            "sheet_sigma_um": 1e6 * light.sheet,
            "psf_sigma_px": light.psf_px,
        },
        "maps": [_map(baseline) for baseline in BASELINES],
        "limits": [
            {
                "focal_mm": 1e3 * focal,
                **{
                    f"delta_um_for_{1e3 * claim:g}_mm_at_l_{1e3 * baseline:g}": 1e6
                    * delta_limit(Head.at_stand_off(baseline, focal), claim)
                    for baseline, claim in CLAIMS
                },
            }
            for focal in FOCALS
        ],
        "choice": {
            "rule": "smallest baseline on a 5 mm grid whose largest |dZ| over ±1 mm is 0.2 mm or less",
            "chosen_mm": 1e3 * (smallest_baseline(DELTA) or float("nan")),
            "chosen_for_delta_um": [
                1e6 * delta_limit(one_apart, DEMAND),
                1e6 * delta_limit(Head.at_stand_off(0.035, FOCAL), DEMAND),
            ],
            "baselines": [_row(baseline, light) for baseline in GRID],
        },
        "energy": {
            "change_from_30_to_35": float(
                peak_power(Head.at_stand_off(0.035, FOCAL), 0.0, light)
                / peak_power(Head.at_stand_off(0.030, FOCAL), 0.0, light)
                - 1
            ),
        },
        "statements": statements(),
    }


def statements() -> list[dict[str, str]]:
    """The paper's statements of sections 3.2 and 4.2 about the design, each with a verdict and its figures."""
    small, large = (Head.at_stand_off(baseline, FOCAL) for baseline in BASELINES)
    steep = (1e3 * largest_dz(Head(b, FOCAL, float(np.arctan(TAN_THETA))), DELTA) for b in BASELINES)
    steep_30, steep_35 = steep
    angle = [90 - float(np.degrees(head.theta)) for head in (small, large)]
    limit = [1e6 * delta_limit(head, claim) for head, (_, claim) in zip((small, large), CLAIMS, strict=True)]
    at = 1e3 * largest_dz(small, 1e-6 * limit[1])
    structure = 1e6 * delta_limit(Head(0.035, FOCAL, float(np.arctan(TAN_THETA))), STRUCTURE_CLAIM)
    energy = Light()
    change = float(peak_power(large, 0.0, energy) / peak_power(small, 0.0, energy) - 1)
    return [
        {
            "paper": "error < 0.5 mm at l = 30 mm and < 0.2 mm at l = 35 mm",
            "verdict": "right for a stripe error that is not stated",
            "why": f"needs δ ≤ {limit[0]:.3f} µm and ≤ {limit[1]:.3f} µm (f = 8 mm). At one and the same "
            f"δ = {limit[1]:.3f} µm the two are {at:.3f} and 0.200 mm: a ratio of {at / 0.2:.2f}, not 2.5",
        },
        {
            "paper": "the best baseline follows from the energy on the CCD",
            "verdict": "wrong",
            "why": f"from 30 to 35 mm the peak changes by {100 * change:.1f} %; error and depth range choose",
        },
        {
            "paper": "measurement error is linear in the baseline",
            "verdict": "wrong at a fixed working distance",
            "why": "there it falls as 1/l or faster; it is linear in l only for a fixed θ, where the working distance "
            f"grows too (tanθ = 3.5: {steep_30:.4f} mm at 30 mm, {steep_35:.4f} mm at 35 mm, at δ = 0.48 µm)",
        },
        {
            "paper": "the angle between laser plane and optical axis gets smaller as l grows",
            "verdict": "wrong",
            "why": f"it grows: {angle[0]:.2f}° at 30 mm, {angle[1]:.2f}° at 35 mm (stand-off 150 mm)",
        },
        {
            "paper": "the error's peak moves towards the principal point as l grows",
            "verdict": "wrong",
            "why": f"it moves away: x' = f l/Z = {1e3 * small.vanishing:.3f} mm at 30 mm, "
            f"{1e3 * large.vanishing:.3f} mm at 35 mm",
        },
        {
            "paper": "the measurement range shrinks as l grows",
            "verdict": "right",
            "why": "depths within ±1 mm: "
            + ", ".join(
                f"{1e3 * head.usable_depth()[0]:.0f}…{1e3 * head.usable_depth()[1]:.0f} mm at {1e3 * head.baseline:g}"
                for head in (small, large)
            ),
        },
        {
            "paper": "with l = 35 mm, tanθ = 3.5 and the system at 150 mm",
            "verdict": "two distances",
            "why": f"the light plane meets the axis at l tanθ = 122.5 mm; 150 mm is imaged at x' = {_at_150():.3f} mm",
        },
        {
            "paper": "tanθ = 3.5 keeps the error of the structure within ±0.1 mm",
            "verdict": "right for a stripe error that is not stated",
            "why": f"needs δ ≤ {structure:.3f} µm, {1e-6 * structure / PIXEL:.2f} px of 4.8 µm",
        },
    ]


def _at_150() -> float:
    """x' in mm at which the head of tanθ = 3.5 images its point at 150 mm."""
    head = Head(0.035, FOCAL, float(np.arctan(TAN_THETA)))
    return 1e3 * (head.vanishing - head.baseline * FOCAL / STAND_OFF)


def _map(baseline: float) -> dict[str, Any]:
    head = Head.at_stand_off(baseline, FOCAL)
    axis = np.linspace(-HALF_SENSOR, HALF_SENSOR, 201)
    found = errors(head, axis[None, :], axis[:, None], DELTA)
    return {
        "baseline_mm": 1e3 * baseline,
        "theta_deg": float(np.degrees(head.theta)),
        "largest_mm": {name: 1e3 * float(value.max()) for name, value in found.items()},
        "centre_mm": {name: 1e3 * float(value[100, 100]) for name, value in found.items()},
        "depth_mm": [1e3 * z for z in head.usable_depth()],
    }


def _row(baseline: float, light: Light) -> dict[str, float]:
    head = Head.at_stand_off(baseline, FOCAL)
    near, far = head.usable_depth()
    return {
        "baseline_mm": 1e3 * baseline,
        "largest_dz_mm": 1e3 * largest_dz(head, DELTA),
        "delta_limit_um": 1e6 * delta_limit(head, DEMAND),
        "uniformity": uniformity(head, light),
        "near_mm": 1e3 * near,
        "far_mm": 1e3 * far,
    }


def draw(path: Path) -> None:
    """|dX|, |dY|, |dZ| over the sensor, a row for each baseline, all on one colour scale, as an image file."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

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

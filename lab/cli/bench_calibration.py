"""`cell bench calibration`: the scan head's calibration over many seeds, beside its Cramér–Rao bound."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from cell.apps.cli.options import JsonOption, wide_console
from lab.cli.shown import bar, show, table

FRAMES = {
    "camera": "camera frame, 1000 points",
    "scan": "scan frame, 1000 points",
    "scan_radial_lens": "scan frame, lens without tangential distortion",
    "scan_aligned": "scan frame, rigidly aligned",
    "base": "arm base, 45 points",
}


def calibration(
    seeds: Annotated[int, typer.Option(min=2, max=1000, help="How many heads are drawn and calibrated.")] = 30,
    json: JsonOption = False,
) -> None:
    """Calibrate many drawn scan heads and compare errors, z-scores and chi² with what the noise allows.

    The observations are drawn by code that shares nothing with the estimator; all figures are of simulation.
    """
    from lab.bench.calibration.campaign import campaign
    from lab.bench.calibration.world import Noise

    with bar() as told:
        result = campaign(range(1, seeds + 1), Noise(), lambda done: told(done, f"{done} of {seeds} heads", seeds))
    show(result, json, _print)


def _print(result: Mapping[str, Any]) -> None:
    console = wide_console(150)
    noise = result["assumed_noise"]
    console.print(
        f"simulated, {result['seeds']} seeds, 20 poses each; assumed 1 sigma: dots {noise['dots_px']:g} px, stripe "
        f"{noise['stripe_px']:g} px, rail {noise['rail_mm']:g} mm, arm {noise['arm_radial_mm']:g} mm radial and "
        f"{noise['arm_rotation_mrad']:g} mrad",
        soft_wrap=True,
    )
    rows = []
    for frame, title in FRAMES.items():
        row, theory = result["frames_mm"][frame], result["frames_mm"][frame]["theory"]
        shown = "" if theory is None else f"{theory['mean']:.3f}  {theory['p85']:.3f}  {theory['max']:.3f}"
        values = [f"{row[key]:.4f}" for key in ("mean", "p85", "max", "bound_mean")]
        values += [f"{row['ratio']:.3f}", f"{row['best_mean']:.4f}", f"{row['ratio_same_noise']:.3f}"]
        rows.append((title, *values, shown))
    titles = ("of", "mean D", "85 %", "max D", "bound of mean D", "ratio", "best on same noise", "ratio")
    console.print(table("errors in mm, means over the seeds", (*titles, "reachable: mean, 85 %, max"), rows))
    console.print("Where the camera's frame lies is partly gauge: its error goes into the hand-eye, not into a place.")
    console.print(
        "Best on same noise: the linear estimate that attains the bound, on the same observations; it shares the "
        "seeds' luck, so its ratio is what the estimator loses.",
        soft_wrap=True,
    )
    for key, what in (("chi2_per_dof", "noise as found"), ("chi2_per_dof_drawn_noise", "noise as drawn")):
        chi2 = result[key]
        console.print(f"chi²/dof with the {what}: {chi2['mean']:.4f} ({chi2['least']:.3f} to {chi2['most']:.3f})")
    z = result["z_rms_by_parameter"]
    console.print(
        f"z-scores: RMS {result['z_rms_whitened']:.3f} of their independent parts (the best on the same noise: "
        f"{result['best_z_rms_whitened']:.3f}), {result['z_rms']:.3f} over all parameters; "
        + ", ".join(f"{name} {v:.2f}" for name, v in z.items()),
        soft_wrap=True,
    )

"""How `cell paper` and `cell bench acceptance` show their results to people: tables with units, notes below them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from lab.cli.shown import empty

WAYS = {"nominal": "before: drawn", "staged": "after: steps", "joint": "after: joint"}
"""The head as drawn; calibrated by the paper's steps one by one; by the joint adjustment."""


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False)


def print_figure2(result: Mapping[str, Any]) -> None:
    """The design study: maps, limits on δ, the choice of the baseline, and the paper's statements with a verdict."""
    console = Console()
    delta = result["assumed"]["stripe_error_um"]
    maps = empty(f"largest error over ±1 mm of sensor in mm, stripe error {delta:.2f} µm", "baseline in mm",
                  "dX", "dY", "dZ", "dZ in the middle", "nearest Z", "farthest Z")  # fmt: skip
    for row in result["maps"]:
        top = row["largest_mm"]
        shown = (top["dx"], top["dy"], top["dz"], row["centre_mm"]["dz"])
        maps.add_row(f"{row['baseline_mm']:g}", *(f"{v:.3f}" for v in shown), *(f"{z:.0f}" for z in row["depth_mm"]))
    console.print(maps)
    limits = empty("stripe error δ in µm at which the paper's claims hold", "focal length in mm",
                    "0.5 mm at l = 30 mm", "0.2 mm at l = 35 mm")  # fmt: skip
    for row in result["limits"]:
        focal, small, large = row.values()
        limits.add_row(f"{focal:g}", f"{small:.3f}", f"{large:.3f}")
    console.print(limits)
    choice = empty("choice of the baseline", "baseline in mm", "largest dZ in mm", "δ limit for 0.2 mm in µm",
                    "light, min/max over ±1 mm", "Z in mm")  # fmt: skip
    for row in result["choice"]["baselines"]:
        choice.add_row(f"{row['baseline_mm']:g}", f"{row['largest_dz_mm']:.3f}", f"{row['delta_limit_um']:.3f}",
                       f"{row['uniformity']:.2f}", f"{row['near_mm']:.0f}…{row['far_mm']:.0f}")  # fmt: skip
    console.print(choice)
    low, high = result["choice"]["chosen_for_delta_um"]
    _say(console, f"{result['choice']['rule']}: {result['choice']['chosen_mm']:g} mm, for every δ from {low:.3f} to "
         f"{high:.3f} µm. Light in the middle from 30 to 35 mm: "
         f"{100 * result['energy']['change_from_30_to_35']:.1f} %.")  # fmt: skip
    given = result["assumed"]
    _say(console, f"Assumed: f = {given['focal_mm']:g} mm, light plane and axis meet at {given['stand_off_mm']:g} mm, "
         f"pixels of {given['pixel_um']:g} µm; light: {given['laser_mw']:g} mW over {given['fan_deg']:g}°, "
         f"f/{given['f_number']:g}, albedo {given['albedo']:g}, transmission {given['transmission']:g}.")  # fmt: skip
    verdicts = empty("what the paper says", "", "<statement", "<verdict", "<why")
    for number, row in enumerate(result["statements"], 1):
        verdicts.add_row(str(number), row["paper"], row["verdict"], row["why"])
    console.print(verdicts)
    _say(console, result["note"])


def print_equations(result: Mapping[str, Any]) -> None:
    """One row for each comparison."""
    console = Console()
    table = empty("largest deviation from ray-traced truth in mm", "equation", "<compared", "as printed", "corrected",
                   "<verdict")  # fmt: skip
    for row in result["rows"]:
        table.add_row(row["equation"], row["compared"], _small(row["printed_mm"]), _small(row["corrected_mm"]),
                      row["verdict"])  # fmt: skip
    console.print(table)
    _say(console, result["note"])


def _small(value: float) -> str:
    return f"{value:.4f}" if value >= 1e-4 else f"{value:.0e}"


def print_table1(result: Mapping[str, Any]) -> None:
    """Both tests beside the paper's figures, the assumed noise below."""
    console = Console()
    paper = result["paper"]["section_5_2"]
    points = empty(f"section 5.2: distance from the truth in mm, scan frame, {result['seeds']} heads (simulated)",
                    "points", "<head", "mean", "largest", "85 % below", "below 0.54 mm", "mean, aligned")  # fmt: skip
    for count, ways in result["section_5_2"].items():
        for way, v in ways.items():
            points.add_row(count, WAYS[way], f"{v['mean']:.4f}", f"{v['max']:.4f}", f"{v['p85']:.4f}",
                           f"{100 * v['share_below_0.54']:.1f} %", f"{v['aligned_mean']:.4f}")  # fmt: skip
    points.add_row("1000", "paper, hardware", "", "", "0.54", paper["points_below_0.54_mm"], "")
    console.print(points)
    change, outliers = result["mean_change_mm"], result["outliers"]
    _say(console, f"Expected mean for the assumed noise: {result['bound_scan_frame_mm']:.4f} mm. Mean change from "
         f"before to after: {change['mean']:.2f} mm (paper: {paper['mean_change_mm']} mm; it depends on how far the "
         f"head is off its drawing).")  # fmt: skip
    _say(console, f"Outliers, {outliers['injected']:.0f} put into each sweep (near ones of 0.3 to 0.85 mm, far ones, "
         f"streaks): recall {outliers['recall']:.4f}, precision {outliers['precision']:.4f}, near ones "
         f"{outliers['recall_near']:.4f}; least of all heads {result['least_outlier_recall']:.4f} and "
         f"{result['least_outlier_precision']:.4f}. Paper: {paper['outliers']} seen, the largest "
         f"{paper['largest_outlier_mm']} mm off.")  # fmt: skip
    table = empty("Table 1: 45 points in 5 segments, arm base, mean/largest in mm (paper's as printed)", "head",
                   "X", "Y", "Z", "D")  # fmt: skip
    rows = [(WAYS[way], entry) for way, entry in result["table_1"].items()]
    rows += [
        (name, result["paper"]["table_1"][key]) for key, name in (("optimised", "paper"), ("handscan", "Handscan"))
    ]
    for name, entry in rows:
        table.add_row(name, *(f"{entry[axis]['mean']:.3f}/{entry[axis]['max']:.3f}" for axis in ("x", "y", "z", "d")))
    console.print(table)
    _say(console, f"Expected mean D for the assumed noise: {result['bound_arm_base_mm']:.4f} mm; χ²/dof "
         f"{result['chi2_per_dof']:.3f}.")  # fmt: skip
    for flaw in result["paper"]["flaws"]:
        _say(console, f"As printed the paper's figures cannot be right: {flaw}.")
    _say_noise(console, result["assumed_noise"])
    _say(console, result["note"])


def print_acceptance(result: Mapping[str, Any]) -> None:
    """The worst of each figure, with what noise alone lets one expect."""
    console = Console()
    table = empty(f"acceptance after VDI/VDE 2634-2 and ISO 10360-13, level {result['level']} (simulated)", "figure",
                   "worst place in mm", "expected from stated σ in mm")  # fmt: skip
    for key, name in ACCEPTANCE.items():
        expected = result["expected"].get(key)
        table.add_row(name, f"{result['worst'][key]:.4f}", "" if expected is None else f"{expected:.4f}")
    console.print(table)
    _say_noise(console, result["assumed_noise"])
    _say(console, result["note"])


ACCEPTANCE = {
    "probing_form_mm": "probing error, form, all points but 3 ‰",
    "probing_form_95_mm": "probing error, form, 95 % of the points",
    "probing_size_mm": "probing error, size",
    "sphere_spacing_mm": "sphere spacing error",
    "flatness_mm": "flatness, all points but 3 ‰",
    "flatness_95_mm": "flatness, 95 % of the points",
}


def _say_noise(console: Console, noise: Mapping[str, float]) -> None:
    """One line, 1σ each."""
    _say(console, "assumed noise, 1σ: " + ", ".join(f"{name} {value:g}" for name, value in noise.items()))

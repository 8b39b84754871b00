"""What limits a calibration and what would better it, for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from cell.apps.cli.options import new_table


def print_examination(figures: Mapping[str, Any], pictures: Sequence[Path]) -> None:
    """Coverage, the paper's steps beside the adjustment, the parameters' influence, advice, and where pictures are."""
    console = Console()
    _coverage(console, figures)
    influence = figures["influence"]
    title = f"place error left by the calibration: {influence['total_mm']:.4f} mm RMS at the job's points"
    columns = ("of", ">sigma", "unit", ">alone mm", ">total if known mm")
    table = new_table(title, *columns)
    for row in influence["groups"]:
        table.add_row(f"[bold]{row['name']}[/]", "", "", f"{row['alone_mm']:.4f}", f"{row['if_known_mm']:.4f}")
    table.add_section()
    for row in influence["parameters"]:
        table.add_row(
            row["name"], f"{row['sigma']:.3g}", row["unit"], f"{row['alone_mm']:.4f}", f"{row['if_known_mm']:.4f}"
        )
    console.print(table)
    console.print("Parameters are known together better than apart: what they do alone does not add up to the total.")
    table = new_table("what to add, by the predicted covariance", "what", "kind", ">then mm", ">less")
    for row in figures["advice"]:
        table.add_row(row["what"], row["kind"], f"{row['then_mm']:.4f}", f"{100 * row['gain']:.1f} %")
    console.print(table)
    for check in figures["checks"]:
        if check["text"]:
            console.print(f"doubtful ({check['camera']} camera): {check['text']}", markup=False, soft_wrap=True)
    for path in pictures:
        console.print(f"picture: {path}", markup=False, soft_wrap=True)


def _coverage(console: Console, figures: Mapping[str, Any]) -> None:
    names = (">field", ">depth mm", ">tilt x deg", ">tilt y deg", ">rail mm", ">stripe depth mm", ">worst cell px")
    table = new_table("what the views cover", "camera", *names)
    for camera in ("scan", "target"):
        c = figures[f"{camera}_coverage"]
        ranges = ("depth_mm", "tilt_about_x_deg", "tilt_about_y_deg", "rail_mm", "stripe_depth_mm")
        shown = ["" if c[key] is None else f"{c[key][0]:.0f} to {c[key][1]:.0f}" for key in ranges]
        worst = "" if c["largest_cell_mean_px"] is None else f"{c['largest_cell_mean_px']:.3f}"
        table.add_row(camera, f"{100 * c['field_covered']:.0f} %", *shown, worst)
    console.print(table)

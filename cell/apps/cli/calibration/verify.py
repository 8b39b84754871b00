"""`cell calibrate verify`: how good the stored calibration is today."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import typer

from cell.apps.cli.options import (  # fmt: skip
    ConfigOption,
    JobOption,
    JsonOption,
    Level,
    LevelOption,
    SeedOption,
    SimOption,
    new_table,
    print_json,
)


def register(group: typer.Typer) -> None:
    """Add the command of this file to `cell calibrate`."""
    group.command()(verify)


def verify(
    config: ConfigOption = None,
    sim: SimOption = None,
    seed: SeedOption = 1,
    level: LevelOption = Level.nominal,
    job: JobOption = "pot",
    json: JsonOption = False,
) -> None:
    """Say how good the stored calibration is today, from a view of each deck board and a sweep over the fine one.

    Exit code 0: good, or changed by less than matters at the job's place. 1: the place may be off by a third of its
    tolerance or more, with the suspected part, or the pictures fit worse than they did.
    """
    from cell.apps.cli.progress import ProgressDisplay
    from cell.run.session.supervisor import Cell

    with Cell.open(config, sim=sim, seed=seed, level=level.value, job=job) as cell, ProgressDisplay() as display:
        verification = cell.verify(display, job)
    if json:
        print_json(verification.summary())
    else:
        print_verification(verification.summary())
    if not verification.good:
        raise typer.Exit(1)


def print_verification(summary: Mapping[str, Any]) -> None:
    """The comparison for people: each figure with what a good calibration scatters by, then the decision."""
    from rich.console import Console

    console = Console()
    title = f"observed today against the calibration of {summary['calibration_date']}"
    table = new_table(title, "quantity", ">difference", ">sigma if good", "unit")
    for row in summary["figures"]:
        table.add_row(row["name"], f"{row['value']:+.4f}", f"{row['sigma']:.4f}", row["unit"])
    for kind, value in summary["residuals_over_calibration"].items():
        table.add_row(
            f"{kind}: residual over the calibration's", f"{value:.2f}", "1", f"≤ {summary['residuals_allowed']}"
        )
    console.print(table)
    title = f"changes that show in {summary['detectable_share']:.0%} of checks like this one"
    columns = ("part", "change", ">from", ">wanted", "unit")
    seen = new_table(title, *columns)
    for row in summary["detectable"]:
        size = "none" if row["size"] is None else f"{row['size']:.3f}"
        enough = row["size"] is not None and row["size"] <= row["wanted"]
        seen.add_row(
            row["part"], row["change"], size, f"{row['wanted']:g}", row["unit"], style=None if enough else "yellow"
        )
    console.print(seen)
    if summary["suspects"]:
        allowed = summary["place"]["allowed_mm"]
        off = (">probability", ">place off by, mm", ">at most", f">of {allowed:g} mm allowed")
        suspects = new_table("suspected parts", "part", *off, "most probable change")
        for row in summary["suspects"]:
            change = ", ".join(f"{name} {value:+.3f}" for name, value in row["change"].items())
            most = row["place_error_at_most_mm"]
            error = f"{row['place_error_mm']:.3f}", f"{most:.3f}", f"{most / allowed:.0%}"
            suspects.add_row(row["part"], f"{row['probability']:.0%}", *error, change)
        console.print(suspects)
    console.print(summary["reason"], style="green" if summary["good"] else "red", markup=False, soft_wrap=True)

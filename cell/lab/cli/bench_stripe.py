"""`cell bench stripe`: every method of stripe extraction beside its bound, and its speed beside others'."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cell.cli.options import JsonOption, print_json, wide_console


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(stripe)


def stripe(
    pictures: Annotated[int, typer.Option(min=1, max=100, help="Pictures of 1024 rows for each condition.")] = 3,
    accuracy: Annotated[bool, typer.Option(help="Errors beside the Cramér–Rao bound.")] = True,
    profiles: Annotated[bool, typer.Option(help="Other profiles, widths, texture, colour and depth.")] = True,
    speed: Annotated[bool, typer.Option(help="Time per frame beside others.")] = True,
    picture: Annotated[Path | None, typer.Option(help="Draw RMS over bound against the width here.")] = None,
    json: JsonOption = False,
) -> None:
    """Stripe centres: RMS error, bias and stated deviation of each method beside the bound; speed beside others."""
    from rich.console import Console
    from rich.progress import Progress

    from cell.lab.bench import stripe_accuracy, stripe_profiles, stripe_speed
    from drivers.errors import ConfigError

    if picture is not None and not accuracy:
        raise ConfigError("--picture shows the accuracy: leave --no-accuracy out")
    result: dict[str, Any] = {}
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=1.0)

        def progress(done: float, text: str) -> None:
            bar.update(task, completed=done, description=text)

        if speed:
            result["speed"] = stripe_speed.compare(progress)
        if accuracy:
            result["accuracy"] = stripe_accuracy.campaign(progress, pictures)
        if profiles:
            result["profiles"] = stripe_profiles.campaign(progress, pictures)
    if picture is not None:
        stripe_accuracy.draw_picture(result["accuracy"]["rows"], picture)
    if json:
        print_json(_without_nan(result))
    else:
        _print(result)


def _without_nan(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _without_nan(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_without_nan(value) for value in data]
    return None if isinstance(data, float) and data != data else data


def _profiles(result: dict[str, Any]) -> Any:
    """The table of stripes as workshops have them."""
    from rich.table import Table

    limits = result["limits"]
    low, high = limits["stated_over_true"]
    table = Table(
        title="stripes of a workshop, simulated: RMS about the mean beside the profile's own bound; limits: efficiency "
        f"≥ {limits['least_efficiency']}, stated σ / true {low}–{high}, found ≥ {limits['least_found']:.0%}, "
        f"false ≤ {limits['most_false']:.0%}"
    )
    for name in ("scene", "width px", "bound px", "RMS px", "efficiency", "stated σ / true", "found", "false"):
        table.add_column(name, justify="left" if name == "scene" else "right")
    for name in ("Steger px", "centre of gravity px", "within limits"):
        table.add_column(name, justify="right")

    def number(value: float | None, digits: int) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    for row in result["rows"]:
        table.add_row(
            row["scene"], f"{row['width_px']:.1f}", number(row["bound_px"], 4), number(row["rms_px"], 4),
            number(row["efficiency"], 2), number(row["stated_over_true"], 2), number(row["found"], 3),
            number(row["false"], 3), number(row["steger_px"], 3), number(row["centre_of_gravity_px"], 3),
            "yes" if row["within_limits"] else "no",
        )  # fmt: skip
    return table


def _print(result: dict[str, Any]) -> None:
    from rich.table import Table

    console = wide_console()
    if "accuracy" in result:
        noise = result["accuracy"]["assumed_noise"]
        table = Table(
            title=f"stripe centres, simulated: {noise['electrons_per_dn']:.0f} electrons per DN, read noise "
            f"{noise['read_noise_dn']} DN, 8 bits; {result['accuracy']['points_each']} rows each. The bound is that of "
            "one row alone: Steger's filter takes its neighbours too"
        )
        for name in ("method", "width px", "peak DN", "speckle", "slope DN/px", "bound px", "RMS px", "efficiency"):
            table.add_column(name, justify="left" if name == "method" else "right")
        for name in ("bias px", "stated σ / true", "found"):
            table.add_column(name, justify="right")
        for row in result["accuracy"]["rows"]:
            table.add_row(
                row["method"].replace("_", " "), f"{row['width_px']:.1f}", f"{row['peak_dn']:.0f}",
                f"{row['contrast']:.1f}", f"{row['slope_dn_per_px']:.2f}", f"{row['bound_px']:.4f}",
                f"{row['rms_px']:.4f}", f"{row['efficiency']:.3f}", f"{row['bias_px']:+.4f}",
                f"{row['stated_over_true']:.2f}", f"{row['found']:.3f}",
            )  # fmt: skip
        console.print(table)
    if "profiles" in result:
        console.print(_profiles(result["profiles"]))
    if "speed" in result:
        height, width = result["speed"]["shape"]
        table = Table(title=f"speed at {width}×{height} px, {result['speed']['frames']} pictures streaming by")
        for name in ("what", "ms/frame", "points/s", "times ours", "times reading"):
            table.add_column(name, justify="left" if name == "what" else "right")
        for row in result["speed"]["rows"]:
            if row["ms_per_frame"] is None:
                table.add_row(row["name"], "not installed", "", "", "")
                continue
            table.add_row(
                row["name"], f"{row['ms_per_frame']:.3f}", f"{row['points_per_s']:,.0f}", f"{row['times_ours']:.2f}",
                f"{row['times_reading']:.1f}",
            )  # fmt: skip
        console.print(table)

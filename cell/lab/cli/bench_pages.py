"""`cell bench pages`: the streams of the cell without the operator's screen, with it, and with five pages at it."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.cli.options import JsonOption, SeedOption, print_json, wide_console


def register(bench: typer.Typer) -> None:
    """Add the command of this file to `cell bench`."""
    bench.command("pages")(pages)


def pages(
    seconds: Annotated[float, typer.Option(min=2.0, max=600.0, help="How long each stream is.")] = 20.0,
    rounds: Annotated[int, typer.Option(min=1, max=50, help="How often each.")] = 2,
    seed: SeedOption = 3,
    json: JsonOption = False,
) -> None:
    """Stream to a simulated arm and from its camera: without a console, with one, and with five pages that look."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from cell.lab.bench.pages import measure

    columns = (BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=1.0)
        found = measure(seconds, rounds, seed, lambda part, text: bar.update(task, completed=part, description=text))
    if json:
        print_json(found)
    else:
        _print(found)


def _print(found: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table(
        title=f"streams of {found['seconds']:g} s, {found['cores']} cores; points to the arm, frames at 50 Hz"
    )
    table.add_column("beside")
    names = (
        "load",
        "rate, Hz",
        "median, ms",
        "99 %, ms",
        "bare loop 99 %, ms",
        "frames",
        "lost",
        "server, % of a core",
    )
    for name in names:
        table.add_column(name, justify="right")
    for row in found["rows"]:
        stream, server = row["stream"], row["server"]
        table.add_row(
            row["beside"], f"{row['load']:g}", f"{stream['rate']:.2f}", f"{1e3 * stream['median']:.3f}",
            f"{1e3 * stream['p99']:.3f}", f"{1e3 * row['bare']['p99']:.3f}", str(row["frames"]), str(row["lost"]),
            "" if server is None else f"{100 * server:.1f}",
        )  # fmt: skip
    wide_console().print(table)

"""`cell bench servo`: the stream of 500 points a second to the arm while perception keeps all cores busy."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.cli.options import JsonOption, SeedOption, print_json, wide_console


def register(bench: typer.Typer) -> None:
    """Add the command of this file to `cell bench`."""
    bench.command("servo")(servo)


def servo(
    seconds: Annotated[float, typer.Option(min=2.0, max=600.0, help="How long each of the two streams is.")] = 20.0,
    seed: SeedOption = 1,
    json: JsonOption = False,
) -> None:
    """Stream to a simulated arm, first alone, then beside perception; exit 1 if that missed and a bare loop did not.

    On a machine where a loop that only sleeps is late as well, there is no verdict: the figures say so.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from cell.lab.bench.servo import measure

    columns = (BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=1.0)
        found = measure(seconds, seed, lambda part, text: bar.update(task, completed=part, description=text))
    if json:
        print_json(found)
    else:
        _print(found)
    if found["verdict"] == "missed":
        raise typer.Exit(1)


def _print(found: dict[str, Any]) -> None:
    from rich.table import Table

    console = wide_console()
    low, high = found["limits"]["rate_hz"]
    table = Table(
        title=f"points to the arm, {found['seconds']:g} s each, {found['cores']} cores, load {found['load']:g}; "
        f"to hold: {low:g} to {high:g} Hz, 99 % ≤ {found['limits']['p99_ms']:g} ms"
    )
    table.add_column("beside")
    for name in ("pictures/s", "who", "rate, Hz", "median, ms", "99 %, ms", "longest, ms"):
        table.add_column(name, justify="right")
    for row in found["rows"]:
        for who, name in (("stream", "the driver"), ("bare", "a bare loop")):
            pace = row[who]
            table.add_row(
                row["beside"], f"{row['pictures_per_s']:.0f}", name, f"{pace['rate']:.2f}",
                *(f"{1e3 * pace[key]:.3f}" for key in ("median", "p99", "longest")),
            )  # fmt: skip
    console.print(table)
    console.print(f"verdict: {found['verdict']}", markup=False)

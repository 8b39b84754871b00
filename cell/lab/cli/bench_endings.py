"""`cell bench endings`: what still moves or shines after a kill, a signal or an abort at a random instant."""

from __future__ import annotations

from typing import Annotated

import typer

from cell.cli.options import JsonOption, SeedOption, print_json


def register(bench: typer.Typer) -> None:
    """Add the command of this file to `cell bench`."""
    bench.command("endings")(endings)


def endings(
    count: Annotated[int, typer.Option(min=1, max=1000, help="How many kills, and how many signals and aborts.")] = 40,
    seed: SeedOption = 3,
    speed: Annotated[float, typer.Option(min=0.5, max=5, help="How many times faster than the wall.")] = 3.0,
    json: JsonOption = False,
) -> None:
    """End a run at random instants, over all steps, calibration, verification and jogs; exit 1 if anything goes on."""
    import tempfile
    from pathlib import Path

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from cell.lab.bench.endings import campaign, summary

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with (
        tempfile.TemporaryDirectory(prefix="cell-endings-") as folder,
        Progress(*columns, console=Console(stderr=True)) as bar,
    ):
        task = bar.add_task("", total=2 * count)
        found = campaign(
            Path(folder), count, seed, speed, lambda done, text: bar.update(task, completed=done, description=text)
        )
    result = summary(found, seed, speed)
    if json:
        print_json(result)
    else:
        _print(result)
    if result["moved_or_shone_after"]:
        raise typer.Exit(1)


def _print(result: dict[str, object]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(
        title=f"{result['trials']} endings at random instants, simulated cell, {result['speed']:g} × the wall"
    )
    table.add_column("ended in")
    for name in ("kills", "signals, aborts", f"moves or shines {result['limit_s']} s after", "last motion, s after"):
        table.add_column(name, justify="right")
    rows = result["work"]
    assert isinstance(rows, list)
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    Console().print(table)

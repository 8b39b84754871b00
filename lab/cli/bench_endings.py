"""`cell bench endings`: what still moves or shines after a kill, a signal or an abort at a random instant."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.apps.cli.options import JsonOption, SeedOption
from lab.cli.shown import bar, show, table


def endings(
    count: Annotated[int, typer.Option(min=1, max=1000, help="How many kills, and how many signals and aborts.")] = 40,
    seed: SeedOption = 3,
    speed: Annotated[float, typer.Option(min=0.5, max=5, help="How many times faster than the wall.")] = 3.0,
    json: JsonOption = False,
) -> None:
    """End a run at random instants, over all steps, calibration, verification and jogs; exit 1 if anything goes on."""
    import tempfile
    from pathlib import Path

    from lab.bench.wires.endings import campaign, summary

    with tempfile.TemporaryDirectory(prefix="cell-endings-") as folder, bar() as told:
        found = campaign(Path(folder), count, seed, speed, lambda done, text: told(done, text, 2 * count))
    result = summary(found, seed, speed)
    show(result, json, _print)
    if result["moved_or_shone_after"]:
        raise typer.Exit(1)


def _print(result: dict[str, Any]) -> None:
    from rich.console import Console

    title = f"{result['trials']} endings at random instants, simulated cell, {result['speed']:g} × the wall"
    late = f"moves or shines {result['limit_s']} s after"
    columns = ("ended in", "kills", "signals, aborts", late, "last motion, s after")
    Console().print(table(title, columns, (row.values() for row in result["work"])))

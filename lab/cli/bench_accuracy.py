"""`cell bench accuracy`: the whole job on many simulated cells, its errors beside bounds, limits and the paper."""

from __future__ import annotations

from typing import Annotated

import typer

from cell.apps.cli.options import JobOption, JsonOption, Level
from lab.cli.shown import bar, counted, show


def accuracy(
    seeds: Annotated[int, typer.Option("--seeds", min=1, max=1000, help="How many worlds: seeds 1 to this.")] = 20,
    level: Annotated[
        list[Level] | None, typer.Option("--level", help="How far they deviate from the drawing; may be repeated.")
    ] = None,
    job: JobOption = "pot",
    workers: Annotated[int, typer.Option("--workers", min=0, max=64, help="Processes; 0 is one a core.")] = 0,
    json: JsonOption = False,
) -> None:
    """Calibrate and run many simulated cells on the virtual clock and measure them against the truth.

    At each level the acceptance tests of `cell bench acceptance` are done too, on the first seed's scan head.

    Exit code 1 when a part was placed outside the job's tolerance, or a limit of level nominal is not kept.
    """
    from lab.bench.job.accuracy import campaign
    from lab.cli.bench_tables import print_accuracy

    levels = list(dict.fromkeys(entry.value for entry in level or [Level.nominal]))
    with bar() as told:
        told(0, "the first runs are on their way")
        done = counted(told, (seeds + 1) * len(levels))
        result = campaign(range(1, seeds + 1), levels, job, done, workers)
    show(result, json, print_accuracy)
    by_level = result["levels"].values()
    outside = sum(entry["outcomes"]["placed_outside_tolerance"] for entry in by_level)
    if outside or not all(entry.get("within_limits", True) for entry in by_level):
        raise typer.Exit(1)

"""`cell bench soak`: jobs one after the other over the wires, and what grows."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.cli.options import JobOption, JsonOption, SeedOption, print_json, wide_console


def register(bench: typer.Typer) -> None:
    """Add the command of this file to `cell bench`."""
    bench.command("soak")(soak)


def soak(
    minutes: Annotated[float, typer.Option(min=0.0, max=10000.0, help="For how long jobs are begun.")] = 60.0,
    job: JobOption = "pot",
    seed: SeedOption = 1,
    speed: Annotated[float, typer.Option(min=0.5, max=5.0, help="How many times faster than the wall.")] = 1.0,
    json: JsonOption = False,
) -> None:
    """Repeat a job over the wires of a simulated cell; exit 1 if memory, threads or handles grow from job to job."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from cell.lab.bench.soak import soak as run

    columns = (BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=1.0)
        found = run(
            minutes, seed, job, lambda part, text: bar.update(task, completed=part, description=text), speed=speed
        )
    if json:
        print_json(found)
    else:
        _print(found)
    if found["verdict"].startswith("grows"):
        raise typer.Exit(1)


def _print(found: dict[str, Any]) -> None:
    from rich.table import Table

    console = wide_console()
    jobs = found["jobs"]
    placed = sum(row["outcome"] == "placed" for row in jobs)
    table = Table(
        title=f"{len(jobs)} jobs in {jobs[-1]['minutes']:g} min, {placed} placed, {found['speed']:g} × the wall"
    )
    table.add_column("process")
    for name in ("memory, MB", "a job", "threads", "a job", "handles", "a job"):
        table.add_column(name, justify="right")
    for name, last in jobs[-1]["processes"].items():
        growth = found["growth_a_job"].get(name, {})
        cells = []
        for key, form in (("memory_mb", ".1f"), ("threads", ".0f"), ("handles", ".0f")):
            cells += [f"{last[key]:{form}}", f"{growth[key]:+.2f}" if key in growth else ""]
        table.add_row(name, *cells)
    console.print(table)
    for row in jobs:
        if row["outcome"] != "placed":
            console.print(f"job {row['job']}: {row['outcome']}: {row['reason']}", markup=False)
    console.print(f"verdict: {found['verdict']}", markup=False)

"""`cell bench servo`, `pages` and `soak`: streams to the arm and jobs over the wires, and what they cost."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.apps.cli.options import JobOption, JsonOption, SeedOption, wide_console
from lab.cli.shown import bar, show, table


def servo(
    seconds: Annotated[float, typer.Option(min=2.0, max=600.0, help="How long each of the two streams is.")] = 20.0,
    seed: SeedOption = 1,
    json: JsonOption = False,
) -> None:
    """Stream to a simulated arm, first alone, then beside perception; exit 1 if that missed and a bare loop did not.

    On a machine where a loop that only sleeps is late as well, there is no verdict: the figures say so.
    """
    from lab.bench.wires.servo import measure

    with bar() as told:
        found = measure(seconds, seed, told)
    show(found, json, _servo)
    if found["verdict"] == "missed":
        raise typer.Exit(1)


def _servo(found: dict[str, Any]) -> None:
    low, high = found["limits"]["rate_hz"]
    rows = [
        (row["beside"], f"{row['pictures_per_s']:.0f}", name, f"{row[who]['rate']:.2f}",
         *(f"{1e3 * row[who][key]:.3f}" for key in ("median", "p99", "longest")))
        for row in found["rows"] for who, name in (("stream", "the driver"), ("bare", "a bare loop"))
    ]  # fmt: skip
    title = (
        f"points to the arm, {found['seconds']:g} s each, {found['cores']} cores, load {found['load']:g}; "
        f"to hold: {low:g} to {high:g} Hz, 99 % ≤ {found['limits']['p99_ms']:g} ms"
    )
    columns = ("beside", "pictures/s", "who", "rate, Hz", "median, ms", "99 %, ms", "longest, ms")
    console = wide_console()
    console.print(table(title, columns, rows))
    console.print(f"verdict: {found['verdict']}", markup=False)


def pages(
    seconds: Annotated[float, typer.Option(min=2.0, max=600.0, help="How long each stream is.")] = 20.0,
    rounds: Annotated[int, typer.Option(min=1, max=50, help="How often each.")] = 2,
    seed: SeedOption = 3,
    json: JsonOption = False,
) -> None:
    """Stream to a simulated arm and from its camera: without a console, with one, and with five pages that look."""
    from lab.bench.wires.pages import measure

    with bar() as told:
        found = measure(seconds, rounds, seed, told)
    show(found, json, _pages)


def _pages(found: dict[str, Any]) -> None:
    rows = [
        (row["beside"], f"{row['load']:g}", f"{row['stream']['rate']:.2f}", f"{1e3 * row['stream']['median']:.3f}",
         f"{1e3 * row['stream']['p99']:.3f}", f"{1e3 * row['bare']['p99']:.3f}", row["frames"], row["lost"],
         None if row["server"] is None else f"{100 * row['server']:.1f}")
        for row in found["rows"]
    ]  # fmt: skip
    title = f"streams of {found['seconds']:g} s, {found['cores']} cores; points to the arm, frames at 50 Hz"
    columns = ("beside", "load", "rate, Hz", "median, ms", "99 %, ms", "bare loop 99 %, ms", "frames", "lost",
               "server, % of a core")  # fmt: skip
    wide_console().print(table(title, columns, rows))


def soak(
    minutes: Annotated[float, typer.Option(min=0.0, max=10000.0, help="For how long jobs are begun.")] = 60.0,
    job: JobOption = "pot",
    seed: SeedOption = 1,
    speed: Annotated[float, typer.Option(min=0.5, max=5.0, help="How many times faster than the wall.")] = 1.0,
    json: JsonOption = False,
) -> None:
    """Repeat a job over the wires of a simulated cell; exit 1 if memory, threads or handles grow from job to job."""
    from lab.bench.wires.soak import soak as run

    with bar() as told:
        found = run(minutes, seed, job, told, speed=speed)
    show(found, json, _soak)
    if found["verdict"].startswith("grows"):
        raise typer.Exit(1)


def _soak(found: dict[str, Any]) -> None:
    console, jobs = wide_console(), found["jobs"]
    placed = sum(row["outcome"] == "placed" for row in jobs)
    rows = []
    for name, last in jobs[-1]["processes"].items():
        growth = found["growth_a_job"].get(name, {})
        row = [name]
        for key, form in (("memory_mb", ".1f"), ("threads", ".0f"), ("handles", ".0f")):
            row += [f"{last[key]:{form}}", f"{growth[key]:+.2f}" if key in growth else ""]
        rows.append(row)
    title = f"{len(jobs)} jobs in {jobs[-1]['minutes']:g} min, {placed} placed, {found['speed']:g} × the wall"
    console.print(table(title, ("process", "memory, MB", "a job", "threads", "a job", "handles", "a job"), rows))
    for job in jobs:
        if job["outcome"] != "placed":
            console.print(f"job {job['job']}: {job['outcome']}: {job['reason']}", markup=False)
    console.print(f"verdict: {found['verdict']}", markup=False)

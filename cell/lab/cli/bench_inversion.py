"""`cell bench inversion`: the pose inversion's campaigns, beside other libraries and on scans that must be refused."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.cli.options import JsonOption, print_json, wide_console


def register(app: typer.Typer) -> None:
    """Add the commands of this file to the sub-app `bench`."""
    app.command()(inversion)


def inversion(
    starts: Annotated[int, typer.Option("--starts", min=4, help="Starts for each part, near and far.")] = 40,
    cases: Annotated[int, typer.Option("--cases", min=1, help="Scans for each case that must not mislead.")] = 20,
    peers: Annotated[bool, typer.Option(help="Run small_gicp and Open3D beside ours.")] = True,
    json: JsonOption = False,
) -> None:
    """Find the pose of five parts from near and far, with clutter and 40 % missing, and refuse what must be refused."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from cell.lab.bench.inversion_report import campaign

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("inversion", total=None)
        report = campaign(starts, cases, peers, lambda done, total: progress.update(bar, completed=done, total=total))
    if json:
        print_json(report)
    else:
        _print(report)


def _print(report: dict[str, Any]) -> None:
    from rich.table import Table

    console = wide_console(140)
    table = Table(
        title="Pose inversion: 10,000 points, same cloud and start, one thread; clean, 20 % clutter, 40 % missing, both"
    )
    for title in (
        "part",
        "start",
        "method",
        "starts",
        "converged %",
        "median mm",
        "95 % mm",
        "median mrad",
        "95 % mrad",
    ):
        table.add_column(title, justify="left" if title in ("part", "start", "method") else "right")
    for title in ("CPU ms", "× ours"):
        table.add_column(title, justify="right")
    for row in report["registration"]:
        shown = [value for key, value in row.items() if key != "converged_percent_by_setting"]
        table.add_row(*("–" if value is None else str(value) for value in shown))
    console.print(table)
    for name, reason in report["not_run"].items():
        console.print(f"{name}: {reason}", markup=False)
    cases = Table(title="Scans that must not mislead: job tolerance 0.6 mm, 6 mrad")
    for title in ("case", "within", "refused", "outside", "worst mm", "worst mrad", "refused, for example, because"):
        cases.add_column(title)
    for row in report["refusals"]:
        cases.add_row(*("–" if value is None else str(value).partition(". ")[0] for value in row.values()))
    console.print(cases)
    cover = report["coverage"]
    console.print(
        f"stated 95 % ellipsoids hold {cover['ellipsoid_95_percent']} % of {cover['scans']} errors, "
        f"z-scores {cover['z_score_rms']}; noise: {report['assumed_noise']}",
        markup=False,
    )

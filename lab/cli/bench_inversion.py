"""`cell bench inversion`: the pose inversion's campaigns, on scans to be placed and on scans that must be refused."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.apps.cli.options import JsonOption, wide_console
from lab.cli.shown import bar, show, table


def inversion(
    starts: Annotated[int, typer.Option("--starts", min=4, help="Starts for each part, near and far.")] = 40,
    cases: Annotated[int, typer.Option("--cases", min=1, help="Scans for each case that must not mislead.")] = 20,
    json: JsonOption = False,
) -> None:
    """Find the pose of five parts from near and far, with clutter and 40 % missing, and refuse what must be refused."""
    from lab.bench.inversion.report import campaign

    with bar() as told:
        report = campaign(starts, cases, lambda done, total: told(done, "", total))
    show(report, json, _print)


def _print(report: dict[str, Any]) -> None:
    console = wide_console(140)
    columns = ("part", "<start", "starts", "converged %", "median mm", "95 % mm", "median mrad", "95 % mrad", "CPU ms")
    rows = [
        [value for key, value in row.items() if key != "converged_percent_by_setting"] for row in report["registration"]
    ]
    title = "Pose inversion: 10,000 points, one thread; clean, 20 % clutter, 40 % missing, both"
    console.print(table(title, columns, rows))
    ended = ("case", "within", "refused", "outside", "worst mm", "worst mrad", "<refused, for example, because")
    rows = [
        ["–" if value is None else str(value).partition(". ")[0] for value in row.values()]
        for row in report["refusals"]
    ]
    console.print(table("Scans that must not mislead: job tolerance 0.6 mm, 6 mrad", ended, rows))
    cover = report["coverage"]
    console.print(
        f"stated 95 % ellipsoids hold {cover['ellipsoid_95_percent']} % of {cover['scans']} errors, "
        f"z-scores {cover['z_score_rms']}; noise: {report['assumed_noise']}",
        markup=False,
    )

"""`cell bench verify`: how often a disturbed calibration is found, and a good one suspected."""

from __future__ import annotations

from typing import Annotated

import typer

from cell.cli.options import JsonOption, Level, LevelOption, print_json


def register(bench: typer.Typer) -> None:
    """Add the command of this file to `cell bench`."""
    bench.command("verify")(verify)


def verify(
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="How many worlds.")] = 20,
    level: LevelOption = Level.nominal,
    json: JsonOption = False,
) -> None:
    """Find 0.2 mm or 0.05° in every part of the chain, over many simulated worlds (no pictures are rendered)."""
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

    from cell.lab.bench.verification import CHECKS_OF_A_GOOD_ONE, KINDS_OF_CHANGE, campaign, disturbances

    chosen = disturbances()
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=seeds * (len(chosen) + KINDS_OF_CHANGE + 1))

        def progress(text: str) -> None:
            bar.update(task, advance=1, description=text)

        summary = campaign(range(1, seeds + 1), level.value, chosen, progress).summary(level.value, seeds)
    if json:
        print_json(summary)
        return
    table = Table(title=f"verification over {seeds} worlds, level {level.value}")
    columns = (
        "disturbance",
        "checks",
        "found %",
        "in 95 % from",
        "unit",
        "its part named first %",
        "among the suspects %",
    )
    for k, name in enumerate(columns):
        table.add_column(name, justify="right" if k else "left")
    for row in summary["disturbances"]:
        keys = ("checks", "found_percent", "detectable_mean", "unit", "named_first_percent", "among_suspects_percent")
        table.add_row(row["name"], *(str(row[key]) for key in keys))
    console = Console()
    console.print(table)
    promised = Table(title="changes as large as the verification says it finds in 95 % of checks")
    for k, name in enumerate(
        ("part", "change", "mean", "largest", "wanted", "unit", "checks", "found %", "bad at a third %")
    ):
        promised.add_column(name, justify="right" if k > 1 else "left")
    for row in summary["detectable"]:
        promised.add_row(*(str(value) for value in row.values()))
    console.print(promised)
    console.print(f"found of changes of this size: {summary['found_at_detectable_percent']:g} %")
    console.print(
        f"called bad where the place is off by a third of its tolerance: {summary['bad_at_a_third_percent']:g} %"
    )
    console.print(
        f"false alarms: {summary['false_alarm_percent']:g} % of {summary['checks_of_good']} checks of good "
        f"calibrations, {CHECKS_OF_A_GOOD_ONE} per world, in {summary['calibrations_with_a_false_alarm']} of {seeds} "
        f"worlds; a change was seen in {summary['change_seen_percent']:g} %"
    )

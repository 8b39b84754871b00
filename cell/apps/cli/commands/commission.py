"""`cell commission`: from the crate to the first part, one check after the other."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.apps.cli import options
from cell.apps.cli.options import CellClock, ConfigOption, Confirm, Level, new_table, print_json, wide_console
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from cell.apps.commission.check import CommissionCheck, Result
    from cell.apps.commission.sequence import Commissioning
    from cell.apps.commission.workplace import Person


OnlyArgument = Annotated[list[str] | None, typer.Argument(help="Only these checks; without any, all of them.")]
TruthOption = Annotated[
    Path | None, typer.Option(help="With --sim: the simulated cell is the one of this configuration, not of --config.")
]
ClockOption = Annotated[CellClock, typer.Option(help='With --sim: "virtual" is without wires and without waiting.')]
ConfirmOption = Annotated[
    Confirm | None, typer.Option(help="Who confirms: with --sim a simulated person unless told otherwise.")
]


def commission(
    only: OnlyArgument = None, config: ConfigOption = None, job: options.JobOption = "pot",
    until: Annotated[str | None, typer.Option(help="Stop after the check of this name.")] = None,
    again: Annotated[bool, typer.Option("--again", help="Do these checks again, also those that are good.")] = False,
    show: Annotated[bool, typer.Option("--list", help="Only say how the checks stand; nothing is connected.")] = False,
    sim: options.SimOption = None, truth: TruthOption = None, seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal, clock: ClockOption = "wall", confirm: ConfirmOption = None,
    json: options.JsonOption = False,
) -> None:  # fmt: skip
    """Take a cell into service: checks in a safe order, each confirmed before its axis first moves.

    What is found wrong is named, and written into cell.toml if you agree; the old file is kept. The command goes on
    where it stood. Exit code 0: every check that was asked for is good; 1: one is not.
    """
    from rich.console import Console

    from cell.apps.cli.progress import tell_question
    from cell.apps.commission.check import write_protocol
    from cell.apps.commission.sequence import CHECKS, begin, chosen, confirms_itself

    if sim != "all" and (truth is not None or confirm == "simulated"):
        raise ConfigError("--truth and --confirm simulated are for a cell that is all simulated; give --sim all")
    checks = chosen(only or (), until)
    console = Console(stderr=json, highlight=False)
    by_itself = confirm != "person" and (sim == "all" or (sim is None and confirms_itself(config)))
    made = begin(
        config, _person(by_itself, console), partial(_show, console),
        job=job, sim=sim, seed=seed, level=level.value, clock=clock, truth=truth,
    )  # fmt: skip
    made.workplace.heard = tell_question
    if show:
        _list(made, checks, json)
        return
    if again:
        made.progress.forget([check.name for check in checks])
    try:
        good = made.go(checks)
        protocol = write_protocol(made.progress, CHECKS, made.workplace.config)
        now = made.workplace.config
    finally:
        made.workplace.close()
    if json:
        rows = {
            check.name: {"standing": made.progress.standing(check, now), **(made.progress.result(check.name) or {})}
            for check in checks
        }
        print_json({"good": good, "mended": made.progress.mended, "checks": rows, "protocol": str(protocol)})
    else:
        _print_mended(made, console)
        console.print(f"protocol: {protocol}", markup=False)
    if not good:
        raise typer.Exit(1)


def _print_mended(made: Commissioning, console: Console) -> None:
    for entry in made.progress.mended:
        text = f"{entry['name']}: {entry['what']}; configured {entry['told']}, measured {entry['found']}"
        console.print(f"found and mended: {text}", style="yellow", markup=False)


def _person(simulated: bool, console: Console) -> Person:
    from cell.apps.commission.workplace import Person, SimulatedPerson

    if simulated:
        return SimulatedPerson(lambda text: console.print(text, style="dim", markup=False))
    return Person(lambda text: typer.confirm(text, err=True))


def _show(console: Console, check: CommissionCheck, verdict: str, result: Result | None) -> None:
    from rich.text import Text

    from cell.apps.commission.check import bounds
    from cell.apps.commission.sequence import CHECKS

    number = 1 + CHECKS.index(check)
    style = "green" if verdict.startswith("good") else "yellow" if verdict.startswith("waits") else "red"
    console.print(Text(f"{number:2d}  {check.name}: {check.title}: ").append(verdict, style))
    if result is None:
        return
    if result.readings:
        columns = ("measured", ">value", "unit", ">allowed", "")
        table = new_table(None, *columns, header_style="dim", box=None, pad_edge=False)
        for row in result.readings:
            allowed = bounds(row)
            mark = Text("") if not allowed else Text("ok", "green") if row.ok else Text("outside", "red")
            table.add_row(Text(row.what), f"{row.value:.4g}", Text(row.unit), allowed, mark)
        console.print(table)
    for finding in result.findings:
        console.print(f"FOUND {finding}", style="bold red", markup=False)
    for note in result.notes:
        console.print(f"  {note}", style="dim" if verdict == "good" else "", markup=False)


def _list(made: Commissioning, checks: list[CommissionCheck], json: bool) -> None:
    from cell.config.cell_config import load_config

    config = load_config(made.path)
    keys = ("name", "title", "moves", "far", "fast", "limit", "needs")
    rows = [
        {"standing": made.progress.standing(check, config), **{key: getattr(check, key) for key in keys}}
        for check in checks
    ]
    if json:
        print_json(rows)
        return
    columns = ("name", "standing", "moves", "far", "fast", "limit")
    table = new_table(None, *columns, show_lines=True)
    for row in rows:
        table.add_row(*(str(row[name]) for name in columns))
    console = wide_console()
    console.print(table)
    if any(row["standing"] == "stale" for row in rows):
        console.print(
            "stale: its part of cell.toml or of the job, a check that it needs, or the cell is another now.\n"
            "A simulated cell is another with other --sim, --seed, --level, --clock or --truth: give the same again."
        )

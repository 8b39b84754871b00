"""Options that several commands share, and how they print."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from cell.apps.cli import completion as completing


class Level(StrEnum):
    """How far the simulated world deviates from its nominal geometry."""

    ideal = "ideal"
    nominal = "nominal"
    harsh = "harsh"
    workshop = "workshop"


class CellClock(StrEnum):
    """What a simulated cell keeps time with."""

    wall = "wall"
    virtual = "virtual"


class Confirm(StrEnum):
    """Who confirms what a person has to."""

    person = "person"
    simulated = "simulated"


ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        help="The cell's configuration. Without it, cell.toml of the present folder; where there is none, real devices "
        "are not touched, and a simulated cell has the configuration that ships.",
    ),
]
JobOption = Annotated[
    str,
    typer.Option(
        "--job",
        "-j",
        help="A job file, or a name: NAME.toml of the present folder, else the job that ships.",
        autocompletion=completing.jobs,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON on standard output, nothing else.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, max=999_999, help="Which simulated world.")]
LevelOption = Annotated[Level, typer.Option("--level", help="How far that world deviates from the drawing.")]
SpeedOption = Annotated[float, typer.Option("--speed", min=0.1, max=20, help="How many times faster than the wall.")]
SimOption = Annotated[
    str | None,
    typer.Option(
        "--sim",
        help='"all": start a simulated cell for this command and use it. Or some devices, as in scan_camera,laser: '
        'those are simulated beside the real ones. "none": all real, whatever cell.sim names.',
    ),
]


def print_json(data: Any) -> None:
    """Write JSON to standard output."""
    typer.echo(json.dumps(data, indent=2))


def wide_console(least: int = 120) -> Any:
    """A rich console for wide tables: at least `least` columns also where the output is no terminal."""
    from rich.console import Console

    return Console(width=max(Console().width, least))


def new_table(title: str | None, *columns: str, **looks: Any) -> Any:
    """A rich table without rows; columns that begin with '>' are numbers, flush right. `looks` are the table's own."""
    from rich.table import Table

    table = Table(title=title, **looks)
    for name in columns:
        table.add_column(name.lstrip(">"), justify="right" if name.startswith(">") else "left", overflow="fold")
    return table

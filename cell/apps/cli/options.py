"""Options that several commands share, how they print, and what the shell offers at tab.

That is asked for at each tab, so nothing heavy is loaded where a file's name tells it, and whatever is wrong offers
nothing.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

MOST_RUNS = 50


def runs(ctx: typer.Context, incomplete: str) -> list[str]:
    """Ids of the newest runs beside the configuration that is named, else of the present folder."""
    try:
        config = Path(ctx.params.get("config") or "cell.toml")
        told = tomllib.loads(config.read_text(encoding="utf-8")) if config.is_file() else {}
        folder = config.parent / str(told.get("cell", {}).get("runs", "runs"))
        names = sorted((entry.name for entry in folder.iterdir() if (entry / "journal.sqlite").exists()), reverse=True)
    except (OSError, ValueError, AttributeError):
        return []
    ids = [name.rpartition("-")[2] for name in names[:MOST_RUNS]]
    return [name for name in (*ids, *(names if incomplete.startswith("2") else ())) if name.startswith(incomplete)]


def jobs(incomplete: str) -> list[str]:
    """Jobs that ship, and those of the present folder."""
    from importlib.resources import files

    shipped = {entry.name for entry in files("cell").joinpath("jobs").iterdir()}
    own = {path.name for path in Path().glob("*.toml") if _is_job(path)}
    names = {name.removesuffix(".toml") for name in shipped | own if name.endswith(".toml")}
    return sorted(name for name in names if name.startswith(incomplete))


def _is_job(path: Path) -> bool:
    try:
        return "job" in tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False


def devices(incomplete: str) -> list[str]:
    """Devices of a cell."""
    from cell.config.files import DEVICES

    return _beginning(incomplete, DEVICES)


def among(*names: str) -> Callable[[str], list[str]]:
    """These words."""
    return lambda incomplete: _beginning(incomplete, names)


def faults(incomplete: str) -> list[str]:
    """Faults of a simulated cell; the step and how far it is then, as in `@laser_sweep:40%`, are for the person."""
    from sim_backends.faults import FAULT_NAMES

    return _beginning(incomplete, FAULT_NAMES)


def steps(incomplete: str) -> list[str]:
    """Steps of the jobs that ship."""
    from cell.procedures.steps.kinds import PLACE

    return _beginning(incomplete, PLACE.names)


def effects(incomplete: str) -> list[str]:
    """Effects of a workshop in a simulated world."""
    from sim_backends.world.levels import Effects

    return _beginning(incomplete, Effects.names())


def _beginning(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]


class Level(StrEnum):
    """How far the simulated world deviates from its nominal geometry."""

    ideal = "ideal"
    nominal = "nominal"
    harsh = "harsh"
    workshop = "workshop"
    outdoor = "outdoor"


CellClock = Literal["wall", "virtual"]
"""What a simulated cell keeps time with."""
Confirm = Literal["person", "simulated"]
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
        autocompletion=jobs,
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


def print_json(data: object) -> None:
    """Write JSON to standard output."""
    typer.echo(json.dumps(data, indent=2))


def wide_console(least: int = 120) -> Console:
    """A rich console for wide tables: at least `least` columns also where the output is no terminal."""
    from rich.console import Console

    return Console(width=max(Console().width, least))


def new_table(title: str | None, *columns: str, **looks: Any) -> Table:
    """A rich table without rows; columns that begin with '>' are numbers, flush right. `looks` are the table's own."""
    from rich.table import Table

    table = Table(title=title, **looks)
    for name in columns:
        table.add_column(name.lstrip(">"), justify="right" if name.startswith(">") else "left", overflow="fold")
    return table

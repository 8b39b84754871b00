"""`cell export`: the cloud of a run for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cell.apps.cli.commands.runs import RunArgument
from cell.apps.cli.options import ConfigOption, JsonOption, print_json


class Format(StrEnum):
    """What can be written."""

    ply = "ply"
    e57 = "e57"
    stl = "stl"
    mesh = "mesh"


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(export)


def export(
    name: RunArgument = None,
    kind: Annotated[
        Format, typer.Option("--format", "-f", help="ply, e57: the points; stl, mesh: triangles (mesh: coloured PLY).")
    ] = Format.ply,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file. Without it, in the run's folder.")] = None,
    job: Annotated[
        str | None, typer.Option("--job", "-j", help="The job whose nominal surface to compare with; else the run's.")
    ] = None,
    limit: Annotated[str, typer.Option(help="Deviation at which the colours end, such as 0.2 mm.")] = "0.2 mm",
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Write a run's cloud as PLY, E57 or mesh, coloured by its deviation from the nominal surface, in metres."""
    from cell.config.cell_config import beside, find_config, load_config
    from cell.run.folder import find_run
    from cell.run.report.export import SUFFIXES, export_run
    from drivers.common.units import parse_quantity
    from drivers.errors import ConfigError

    try:
        end = parse_quantity(limit, "mm", 0.001, 100)
    except ValueError as error:
        raise ConfigError(f"--limit: {error}") from error
    source = find_config(config, simulated=True)
    folder = find_run(beside(source) / load_config(source).cell.runs, name, "job")
    path = out or folder / f"export-{kind.value}{SUFFIXES[kind.value]}"
    if path.suffix.lower() != SUFFIXES[kind.value]:
        raise ConfigError(f"--out {path}: a file of format {kind.value} ends in {SUFFIXES[kind.value]}")
    if not path.parent.is_dir():
        raise ConfigError(f"--out {path}: there is no folder {path.parent}; make it first")
    written = export_run(folder, kind.value, path, job, end)
    if json:
        print_json(written)
        return
    deviation = written.get("deviation_mm")
    typer.echo(
        f"{written['file']}: {written['points']} points"
        + (f", {written['triangles']} triangles" if "triangles" in written else "")
        + ("" if deviation is None else f"; off the nominal surface: rms {deviation['rms']:.4f} mm")
    )

"""The table of commands. Their bodies import what they need when they run, so that `cell --help` stays quick."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Annotated

import typer

from cell.apps.cli.calibration import calibrate
from cell.apps.cli.commands import (
    commission,
    console,
    devices,
    doctor,
    export,
    new_job,
    record,
    run,
    runs,
    setup,
    sim,
    watch,
)
from cell.apps.cli.usage import App

COMMANDS = "assembly_cell.commands"
"""Entry points that add commands: called with a `typer.Typer`, whose commands and groups come to those of `cell`."""

app = App(
    name="cell",
    help="Control of a laser-guided assembly cell: drive, photograph, sweep, reconstruct, invert, place.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from cell.base.version import release

        typer.echo(f"cell {release()}")
        raise typer.Exit


@app.callback()
def _cell(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the release and exit.")
    ] = False,
    verbose: Annotated[
        int, typer.Option("--verbose", "-v", count=True, help="Show what happens on standard error; -vv everything.")
    ] = 0,
) -> None:
    """Options before any command."""
    from cell.run.files.logs import console_log

    console_log(verbose)


for group in (run, runs, record, export, calibrate, devices, doctor, commission, setup, new_job, console, watch):
    group.register(app)
app.add_typer(sim.app, name="sim")


def _add_groups() -> None:
    """Add the groups of commands that bring themselves, such as the laboratory's.

    One that is broken, or that takes the name of a command that is there, is left out: it must not take `cell abort`
    with it.
    """
    for entry in sorted(entry_points(group=COMMANDS), key=lambda found: found.name):
        own = typer.Typer()
        try:
            entry.load()(own)
            if taken := _names(own) & _names(app):
                raise ValueError(f"there is a command {', '.join(sorted(taken))} already")
        except (Exception, SystemExit) as error:
            typer.echo(f"warning: the commands of {entry.value} cannot be used: {error}", err=True)
            continue
        app.registered_commands += own.registered_commands
        app.registered_groups += own.registered_groups


def _names(commands: typer.Typer) -> set[str]:
    shown = {command.name or getattr(command.callback, "__name__", "") for command in commands.registered_commands}
    return shown | {str(group.name) for group in commands.registered_groups}


_add_groups()

"""The table of commands. Their bodies import what they need when they run, so that `cell --help` stays quick.

A wrong command line is told in one line, with what was meant to be typed instead."""

import re
import sys
from importlib.metadata import entry_points
from typing import Annotated, Any

import typer

from cell.apps.cli import EXIT_USAGE
from cell.apps.cli.calibration import calibrate
from cell.apps.cli.commands import commission, console, devices, qualify, run, runs, setup
from drivers.errors import CellError, ConfigError

UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Base of what typer raises for a wrong command line, whichever parser it carries."""

_WORDS = (
    (r"Value error, ", ""), (r"Input should be", "it has to be"), (r"a valid integer(, .*)?", "a whole number"),
    (r"a valid number(, .*)?", "a number"), (r"\.$", ""),
)  # fmt: skip


class App(typer.Typer):
    """The table of commands. Called, it runs one and exits; a wrong command line is a `ConfigError`."""

    def __call__(self, *args: object, **settings: object) -> object:
        """Run the command of `sys.argv`."""
        try:
            code = super().__call__(*args, **{**settings, "standalone_mode": False})
        except UsageError as error:
            if text := in_words(error):
                raise ConfigError(text) from error
            code = EXIT_USAGE
        except typer.Abort as error:
            unanswered = "a question was not answered, so nothing was done; answer it, or give it as an option"
            raise CellError(unanswered) from error
        sys.exit(code if isinstance(code, int) else 0)


def in_words(error: Any) -> str:
    """What is wrong, in one line, with the command whose help tells more; empty where the help was shown already."""
    if not (text := " ".join(str(error.format_message()).split())):
        return ""
    for pattern, word in _WORDS:
        text = re.sub(pattern, word, text)
    if re.search(r"No such command '(bench|paper)'", text):
        return f"{text}; the laboratory brings it: `pip install -e lab` in the checkout"
    command = error.ctx.command_path if error.ctx is not None else "cell"
    return f"{text}; `{command} --help` shows what may be given"


COMMANDS = "assembly_cell.commands"
"""Entry points that add commands: called with a `typer.Typer`, whose commands and groups come to those of `cell`."""

app = App(
    name="cell",
    help="Control of a laser-guided assembly cell: drive, photograph, sweep, reconstruct, invert, place.",
    no_args_is_help=True, add_completion=True, pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip


def _show_version(wanted: bool) -> None:
    if wanted:
        from cell.run.folder import release

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
    from cell.run.folder import console_log

    console_log(verbose)


for command in (
    run.run, run.dry_run, run.resume, qualify.qualify,
    runs.abort, runs.pause, runs.go_on, runs.confirm, runs.runs, runs.health, runs.report, runs.export, runs.replay,
    devices.jog, devices.home, devices.recover, devices.diag, devices.find, devices.devices, devices.doctor,
    setup.init, setup.check, setup.new_job, commission.commission, console.console,
):  # fmt: skip
    # A distance such as -10mm is no option.
    settings = {"ignore_unknown_options": True} if command is devices.jog else None
    app.command(command.__name__.replace("_", "-"), context_settings=settings)(command)
calibrate.register(app)
app.add_typer(runs.record, name="record")
app.add_typer(setup.sim, name="sim")


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

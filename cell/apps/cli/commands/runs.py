"""`cell abort`, `pause`, `go-on`, `confirm`, `runs`, `report`: what goes on in another process, and what was run."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated

import typer

from cell.apps.cli import options as completing
from cell.apps.cli.options import ConfigOption, JsonOption, print_json

RunArgument = Annotated[
    str | None,
    typer.Argument(help="A run's folder, name or id. Without it, the newest.", autocompletion=completing.runs),
]
NoiseOption = Annotated[
    bool, typer.Option("--noise", help="Also show the noise that is assumed, and how several sweeps agree.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(abort)
    app.command()(pause)
    app.command("go-on")(go_on)
    app.command()(confirm)
    app.command()(runs)
    app.command()(report)


def abort(
    name: RunArgument = None,
    config: ConfigOption = None,
    reason: Annotated[str, typer.Option(help="Goes into the report.")] = "asked for with `cell abort`",
) -> None:
    """End what is going on in another process (run, calibration, verification, homing, jog): the cell is stopped."""
    from cell.run.folder import list_runs, listens
    from drivers.errors import ConfigError

    going = [run for run in list_runs(_going_folder(config)) if listens(run)] if name is None else []
    if not going:
        _ask(name, config, "abort", reason, "asked {} to end")
    # Whoever says stop does not choose: everything that goes on here ends.
    unasked = []
    for run in going:
        try:
            _ask(str(run), config, "abort", reason, "asked {} to end")
        except ConfigError as error:
            if listens(run):
                unasked.append(str(error))
            else:
                typer.echo(f"{run.name} has ended meanwhile")
    if unasked:
        raise ConfigError("not asked to end: " + "; ".join(unasked))


def pause(name: RunArgument = None, config: ConfigOption = None) -> None:
    """Hold what is going on in another process: at its next safe point, that is before its next free motion or step."""
    _ask(name, config, "pause", "asked for with `cell pause`", "asked {} to hold before its next motion")


def go_on(name: RunArgument = None, config: ConfigOption = None) -> None:
    """Let a paused run go on."""
    _ask(name, config, "go-on", "asked for with `cell go-on`", "asked {} to go on")


def confirm(
    name: RunArgument = None,
    config: ConfigOption = None,
    question: Annotated[
        int | None,
        typer.Option(help="The number that was shown with the question; without it, the one that waits now."),
    ] = None,
    by: Annotated[str | None, typer.Option(help="Who has looked; without it, the user's name.")] = None,
) -> None:
    """Say that you have looked at the cell and that the waiting run may clear its fault and go on.

    The word counts for one question only. Without its number, a terminal is asked whether it is the one that was meant.
    """
    import getpass
    import sys

    from cell.apps.cli import EXIT_FAILED
    from cell.run.folder import awaited_word
    from drivers.errors import ConfigError

    folder = _going(name, config)
    if (waits := awaited_word(folder)) is None:
        raise ConfigError(f"{folder.name} waits for nobody's word; there is nothing to confirm")
    if question not in (None, waits.number):
        raise ConfigError(f"{folder.name} does not wait for question {question} but for {waits}")
    typer.echo(str(waits))
    if question is None and sys.stdin.isatty() and not typer.confirm("Have you looked, and may the run go on?"):
        raise typer.Exit(EXIT_FAILED)
    answer = f"told {{}} that question {waits.number} is confirmed"
    _ask(str(folder), config, "confirm", reason=by or getpass.getuser(), answer=answer, number=waits.number)


def _ask(name: str | None, config: Path | None, kind: str, reason: str, answer: str, number: int | None = None) -> None:
    from drivers.errors import ConfigError
    from statemachine.journal import JournalError, request

    folder = _going(name, config)
    try:
        request(folder, kind, reason, number)
    except JournalError as error:
        raise ConfigError(str(error)) from error
    typer.echo(answer.format(folder.name))


def _going(name: str | None, config: Path | None) -> Path:
    from cell.run.folder import find_going

    return find_going(_going_folder(config), name)


def runs(config: ConfigOption = None, json: JsonOption = False) -> None:
    """List what was run, newest last, a line each: when, what, how it ended, how long it took, and why."""
    from cell.apps.cli.display import print_runs
    from cell.run.folder import list_runs, run_row

    rows = [run_row(folder) for folder in list_runs(folder_of_runs(config))]
    if json:
        print_json(rows)
    else:
        print_runs(rows)


def report(
    name: RunArgument = None,
    config: ConfigOption = None,
    json: JsonOption = False,
    noise: NoiseOption = False,
    html: Annotated[
        bool, typer.Option("--html", help="Write one HTML file instead, to look at in a browser or to print.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The HTML file. Without it, report.html in the run's folder.")
    ] = None,
) -> None:
    """Show the report of a run."""
    from cell.apps.cli.display import print_report
    from cell.run.folder import find_run, read_report
    from drivers.errors import ConfigError

    if out is not None and not html:
        raise ConfigError("--out names the file of --html; give both")
    folder = find_run(folder_of_runs(config), name)
    if html:
        # Drawing is slow to load; whoever reads a report on the screen does not wait for it.
        from cell.run.report.page.make import write_page

        path = out or folder / "report.html"
        size = write_page(folder, path)
        if json:
            print_json({"run": folder.name, "file": str(path), "bytes": size})
        else:
            typer.echo(f"{path}: {size / 1e6:.2f} MB; open it in a browser, or print it")
        return
    data = read_report(folder)
    if json:
        print_json(data)
    else:
        print_report(data, str(folder), noise=noise, whole=True)


def folder_of_runs(config: Path | None) -> Path:
    """Where the runs are of the cell that is configured; raises `ConfigError` where its file cannot be read."""
    from cell.config.files import find_config, runs_folder

    path = find_config(config, simulated=True)
    try:
        tomllib.loads("" if path is None else path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        from cell.config.cell_config import tables_of

        # Raises what is wrong, in words; it is slow to load.
        tables_of(path)
    return runs_folder(path)


def _going_folder(config: Path | None) -> Path:
    """As `folder_of_runs`, for who ends or holds what goes on: the configuration may have become wrong meanwhile."""
    from cell.config.files import find_config, runs_folder

    return runs_folder(find_config(config, simulated=True))

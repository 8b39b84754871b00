"""`cell record repair`, `info`, `export`: what a run's record holds; `cell replay`: perception fed with a run again."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from cell.apps.cli.commands.runs import RunArgument, folder_of_runs
from cell.apps.cli.options import ConfigOption, JsonOption, print_json

app = typer.Typer(help="The record of a run, record.mcap.", no_args_is_help=True)


class Wires(StrEnum):
    """How raw traffic can be written."""

    candump = "candump"
    text = "text"


def register(commands: typer.Typer) -> None:
    """Add the commands of this file."""
    commands.add_typer(app, name="record")
    commands.command()(replay)


@app.callback()
def _group() -> None:
    """The record of a run, record.mcap."""


@app.command()
def repair(name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Close the record of a run that was cut off, so that every reader opens it; a whole one stays as it is."""
    from cell.run.folder import is_going
    from cell.run.record import reading as work
    from drivers.errors import ConfigError

    path, folder = _record(name, config)
    if folder is not None and is_going(folder):
        raise ConfigError(f"{folder.name} is still going on and writes its record; end it first")
    with _bar("repair") as progress:
        done = work.repair(path, progress)
    if json:
        whole = done.whole and done.messages > 0
        told = {"file": str(path), "whole": whole, "messages": done.messages, "lost_bytes": done.lost}
        print_json({**told, "damaged": done.damaged})
    elif done.whole and not done.messages:
        typer.echo(f"{path} is closed and empty: it holds no message; nothing was changed")
    elif done.damaged:
        typer.echo(
            f"{path} was damaged: {'; '.join(done.damaged)}. {done.messages} messages kept, {done.lost} bytes let go; "
            f"the old file is {path.name}{work.DAMAGED}"
        )
    elif done.whole:
        typer.echo(f"{path} is whole, {done.messages} messages; nothing was changed")
    else:
        typer.echo(f"{path} is closed: {done.messages} messages kept, the last {done.lost} bytes were of no use")


@app.command()
def info(name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Show what a record holds: its channels, their messages and sizes, and what was let go."""
    from rich.console import Console
    from rich.table import Table

    from cell.run.record.reading import information

    path, _ = _record(name, config)
    data = information(path)
    if json:
        print_json(data)
        return
    console = Console()
    table = Table("channel", "schema", box=None)
    table.add_column("messages", justify="right")
    table.add_column("kB", justify="right")
    for row in data["channels"]:
        table.add_row(row["topic"], row["schema"], str(row["messages"]), f"{row['bytes'] / 1000:.1f}")
    console.print(table)
    whole = "whole" if data["whole"] else f"cut off, {data['lost_bytes']} bytes at its end are of no use"
    if data["damaged"]:
        whole = f"DAMAGED, it does not fit its CRC: {'; '.join(data['damaged'])}; `cell record repair` leaves that out"
    elif data["closed"] and not data["messages"]:
        whole = "empty, it holds no message"
    typer.echo(f"{path}: {data['bytes'] / 1e6:.1f} MB, {data['messages']} messages over {data['span_s']} s, {whole}")
    if data["cpu_s"] is not None and data["span_s"]:
        typer.echo(f"writing it took {data['cpu_s']:.2f} s of a core, {100 * data['cpu_s'] / data['span_s']:.1f} %")
    if data["dropped"] is None:
        closing = "" if data["closed"] else "; `cell record repair` closes it"
        typer.echo(f"it does not tell what was let go: its last message is missing{closing}")
    for topic, count in (data["dropped"] or {}).items():
        typer.echo(f"let go, because too much came at once: {count} of {topic}")


@app.command()
def export(
    name: RunArgument = None,
    kind: Annotated[
        Wires, typer.Option("--format", "-f", help="candump: the CAN frames; text: all wires, a line each.")
    ] = Wires.candump,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file. Without it, beside the record.")] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Write the raw traffic of a run: CAN in candump's log format, or CAN, serial lines and RTDE as text."""
    from cell.run.record.reading import FORMATS
    from drivers.errors import ConfigError

    path, _ = _record(name, config)
    suffix, write = FORMATS[kind.value]
    target = out or path.with_suffix(suffix)
    if not target.parent.is_dir():
        raise ConfigError(f"--out {target}: there is no folder {target.parent}; make it first")
    count = write(path, target)
    if json:
        print_json({"file": str(target), "lines": count})
        return
    typer.echo(f"{target}: {count} {'CAN frames' if kind is Wires.candump else 'lines'}")
    if not count:
        typer.echo("nothing passed on a wire: on the virtual clock, or with that device in the same process, none does")


def replay(name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Feed a run's frames and readings through perception again: exits 1 unless cloud and pose come out bit for bit."""
    from cell.apps.cli import EXIT_FAILED
    from cell.run.folder import find_run
    from cell.run.record import replay as work

    folder = find_run(folder_of_runs(config), name, "job")
    with _bar("replay") as progress:
        compared = work.replay(folder, progress)
    same = all(each.same for each in compared)
    if json:
        rows = [{"what": each.what, "same": each.same, "difference": each.difference} for each in compared]
        print_json({"run": folder.name, "same": same, "compared": rows})
    else:
        for each in compared:
            typer.echo(f"{each.what:<32} {each.difference or 'the same, bit for bit'}")
        if not same:
            typer.echo(
                "not the same: this program or its libraries are other ones than those of the run, or its files were "
                "changed; report.json names the version"
            )
    if not same:
        raise typer.Exit(EXIT_FAILED)


def _record(name: str | None, config: Path | None) -> tuple[Path, Path | None]:
    """The record of a run, and the run's folder; or a file by its path."""
    from cell.run.folder import find_run
    from cell.run.record.file import FILE

    if name is not None and Path(name).suffix == ".mcap":
        return Path(name), None
    folder = find_run(folder_of_runs(config), name)
    return folder / FILE, folder


class _bar:
    """A bar on standard error while something long goes on; gives what tells it how far that is."""

    def __init__(self, what: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        text = TextColumn("{task.description}")
        self._progress = Progress(
            text, BarColumn(bar_width=30), TimeElapsedColumn(), console=Console(stderr=True), transient=True
        )
        self._task = self._progress.add_task(what, total=1.0)

    def __enter__(self) -> Any:
        self._progress.start()
        return lambda share, text: self._progress.update(self._task, completed=share, description=text)

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

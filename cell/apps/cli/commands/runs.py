"""What goes on in another process, and what was run.

`cell abort`, `pause`, `go-on`, `confirm`; `cell runs`, `report`, `export`; `cell record repair`, `info`, `export` and
`cell replay` for the record of a run.
"""

import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import typer

from cell.apps.cli import EXIT_FAILED, options
from cell.apps.cli.options import ConfigOption, JsonOption, print_json
from cell.config.files import beside, find_config, runs_folder
from drivers.errors import ConfigError

RunArgument = Annotated[
    str | None, typer.Argument(help="A run's folder, name or id. Without it, the newest.", autocompletion=options.runs)
]
NoiseOption = Annotated[
    bool, typer.Option("--noise", help="Also show the noise that is assumed, and how several sweeps agree.")
]


Format = Literal["ply", "stl", "mesh"]
Wires = Literal["candump", "text"]


def abort(
    name: RunArgument = None,
    config: ConfigOption = None,
    reason: Annotated[str, typer.Option(help="Goes into the report.")] = "asked for with `cell abort`",
    after_part: Annotated[
        bool, typer.Option("--after-part", help="Nothing is stopped: the part is placed, then its batch ends.")
    ] = False,
) -> None:
    """End what is going on in another process (run, calibration, verification, homing, jog): the cell is stopped."""
    from cell.run.folder import list_runs, listens, read_report

    if after_part:
        folder = _going(name, config)
        if (kind := read_report(folder)["kind"]) != "job":
            raise ConfigError(f"{folder.name} is a {kind}, no part of a batch: end it with `cell abort` alone")
        _ask(folder, "end-batch", reason, "asked {} to be the last of its batch")
        return
    going = [run for run in list_runs(_going_folder(config)) if listens(run)] if name is None else []
    if not going:
        _ask(_going(name, config), "abort", reason, "asked {} to end")
    # Whoever says stop does not choose: everything that goes on here ends.
    unasked = []
    for run in going:
        try:
            _ask(_going(str(run), config), "abort", reason, "asked {} to end")
        except ConfigError as error:
            if listens(run):
                unasked.append(str(error))
            else:
                typer.echo(f"{run.name} has ended meanwhile")
    if unasked:
        raise ConfigError("not asked to end: " + "; ".join(unasked))


def pause(name: RunArgument = None, config: ConfigOption = None) -> None:
    """Hold what is going on in another process: at its next safe point, that is before its next free motion or step."""
    _ask(_going(name, config), "pause", "asked for with `cell pause`", "asked {} to hold before its next motion")


def go_on(name: RunArgument = None, config: ConfigOption = None) -> None:
    """Let a paused run go on."""
    _ask(_going(name, config), "go-on", "asked for with `cell go-on`", "asked {} to go on")


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

    from cell.run.folder import awaited_word

    if by is not None and not by.strip():
        raise ConfigError("--by names nobody; say who has looked")
    folder = _going(name, config)
    if (waits := awaited_word(folder)) is None:
        raise ConfigError(f"{folder.name} waits for nobody's word; there is nothing to confirm")
    if question not in (None, waits.number):
        raise ConfigError(f"{folder.name} does not wait for question {question} but for {waits}")
    typer.echo(str(waits))
    if question is None and sys.stdin.isatty() and not typer.confirm("Have you looked, and may the run go on?"):
        raise typer.Exit(EXIT_FAILED)
    answer = f"told {{}} that question {waits.number} is confirmed"
    _ask(_going(str(folder), config), "confirm", by or getpass.getuser(), answer, waits.number)


def _ask(folder: Path, kind: str, reason: str, answer: str, number: int | None = None) -> None:
    from statemachine.journal import JournalError, request

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

    show = print_json if json else print_runs
    show([run_row(folder) for folder in list_runs(folder_of_runs(config))])


def health(config: ConfigOption = None, json: JsonOption = False) -> None:
    """How good the cell is today: what its jobs have seen of each part since the calibration, and when one is due.

    Exit code 1 when it is due now.
    """
    import datetime as dt

    from cell.apps.cli.display import print_health
    from cell.config.cell_config import load_config
    from cell.run.health import health as found

    path = find_config(config, simulated=True)
    loaded = load_config(path)
    calibrations = beside(path) / loaded.cell.calibrations
    told = found(folder_of_runs(config), calibrations, loaded.calibration.max_age, dt.datetime.now().astimezone())
    show = print_json if json else print_health
    show(told.as_dict())
    if told.due_now:
        raise typer.Exit(1)


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

    if out is not None and not html:
        raise ConfigError("--out names the file of --html; give both")
    folder = find_run(folder_of_runs(config), name)
    if html:
        # Drawing is slow to load; whoever reads a report on the screen does not wait for it.
        from cell.run.report.page.make import write_page

        path = out or folder / "report.html"
        _require_own(out, ".html")
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


def export(
    name: RunArgument = None,
    kind: Annotated[
        Format, typer.Option("--format", "-f", help="ply: the points; stl, mesh: triangles (mesh: coloured PLY).")
    ] = "ply",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file. Without it, in the run's folder.")] = None,
    job: Annotated[
        str | None, typer.Option("--job", "-j", help="The job whose nominal surface to compare with; else the run's.")
    ] = None,
    limit: Annotated[str, typer.Option(help="Deviation at which the colours end, such as 0.2 mm.")] = "0.2 mm",
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Write a run's cloud as PLY or mesh, coloured by its deviation from the nominal surface, in metres."""
    from cell.run.folder import find_run
    from cell.run.report.export import SUFFIXES, export_run
    from drivers.common.units import parse_quantity

    try:
        end = parse_quantity(limit, "mm", 0.001, 100)
    except ValueError as error:
        raise ConfigError(f"--limit: {error}") from error
    folder = find_run(folder_of_runs(config), name, "job")
    path = out or folder / f"export-{kind}{SUFFIXES[kind]}"
    if path.suffix.lower() != SUFFIXES[kind]:
        raise ConfigError(f"--out {path}: a file of format {kind} ends in {SUFFIXES[kind]}")
    _require_own(out, path.suffix)
    written = export_run(folder, kind, path, job, end)
    if json:
        print_json(written)
        return
    deviation = written.get("deviation_mm")
    typer.echo(
        f"{written['file']}: {written['points']} points"
        + (f", {written['triangles']} triangles" if "triangles" in written else "")
        + ("" if deviation is None else f"; off the nominal surface: rms {deviation['rms']:.4f} mm")
    )


# --- the record of a run ---

record = typer.Typer(help="The record of a run, record.mcap.", no_args_is_help=True)


@record.command()
def repair(name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Close the record of a run that was cut off, so that every reader opens it; a whole one stays as it is."""
    from cell.run.folder import is_going
    from cell.run.record import reading as work

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


@record.command()
def info(name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Show what a record holds: its channels, their messages and sizes, and what was let go."""
    from rich.console import Console

    from cell.run.record.reading import information

    path, _ = _record(name, config)
    data = information(path)
    if json:
        print_json(data)
        return
    table = options.new_table(None, "channel", "schema", ">messages", ">kB", box=None)
    for row in data["channels"]:
        table.add_row(row["topic"], row["schema"], str(row["messages"]), f"{row['bytes'] / 1000:.1f}")
    Console().print(table)
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


@record.command("export")
def export_wires(
    name: RunArgument = None,
    kind: Annotated[
        Wires, typer.Option("--format", "-f", help="candump: the CAN frames; text: all wires, a line each.")
    ] = "candump",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file. Without it, beside the record.")] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Write the raw traffic of a run: CAN in candump's log format, or CAN, serial lines and RTDE as text."""
    from cell.run.record.reading import FORMATS

    path, _ = _record(name, config)
    suffix, write = FORMATS[kind]
    target = out or path.with_suffix(suffix)
    _require_own(out, suffix)
    count = write(path, target)
    if json:
        print_json({"file": str(target), "lines": count})
        return
    typer.echo(f"{target}: {count} {'CAN frames' if kind == 'candump' else 'lines'}")
    if not count:
        typer.echo("nothing passed on a wire: on the virtual clock, or with that device in the same process, none does")


def replay(name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Feed a run's frames and readings through perception again: exits 1 unless cloud and pose come out bit for bit."""
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


def _require_own(out: Path | None, suffix: str) -> None:
    """Raise `ConfigError` where `out` is there and of another kind, or a run's, or where its folder is missing."""
    if out is None:
        return
    if not out.parent.is_dir():
        raise ConfigError(f"--out {out}: there is no folder {out.parent}; make it first")
    if out.exists() and (out.suffix != suffix or (out.parent / "report.json").exists()):
        raise ConfigError(f"--out {out} is there already, and not of this command; name another file")


@contextmanager
def _bar(what: str) -> Iterator[Callable[[float, str], None]]:
    """A bar on standard error while something long goes on; gives what tells it how far that is."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description}"), BarColumn(bar_width=30), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda share, text: progress.update(task, completed=share, description=text)


# --- where the runs are ---


def folder_of_runs(config: Path | None) -> Path:
    """Where the runs are of the cell that is configured; raises `ConfigError` where its file cannot be read."""
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
    return runs_folder(find_config(config, simulated=True))

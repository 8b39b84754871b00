"""One device at a time, and the computer: `cell jog`, `home`, `recover`, `diag`, `find`, `devices`, `doctor`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from cell.apps.cli import EXIT_FAILED, options
from cell.apps.cli.options import ConfigOption, JsonOption, Level, new_table, print_json, wide_console
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from cell.devices.diagnosis.diagnosis import Diagnosis
    from cell.devices.diagnosis.finding import Found


def jog(
    device: Annotated[
        str | None, typer.Argument(help="rail, arm or vehicle.", autocompletion=options.among("rail", "arm", "vehicle"))
    ] = None,
    motion: Annotated[
        list[str] | None,
        typer.Argument(help="rail: +5mm · arm: z -10mm, rx +2deg or j3 +5deg · vehicle: +0.1m or +5deg."),
    ] = None,
    config: ConfigOption = None,
    job: options.JobOption = "pot",
    lift: Annotated[
        list[str] | None, typer.Option("--lift", help="An interlock that a person lifts; needs a --reason.")
    ] = None,
    reason: Annotated[str, typer.Option("--reason", help="Why interlocks are lifted; it is recorded.")] = "",
    sim: options.SimOption = None,
    seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal,
    json: JsonOption = False,
) -> None:
    """Move one device by a little: refused outside its limits or while a run holds the cell."""
    from cell.apps.cli.progress import tell_question
    from cell.run.jogging import jog as perform
    from cell.run.jogging import needed_for, parse_jog
    from cell.run.session.supervisor import Cell

    if device is None:
        raise ConfigError(
            "say what to move: `cell jog rail +5mm`, `cell jog arm z +5mm`, `cell jog vehicle +0.1m`; with --sim all "
            "in a simulated cell. `cell console` moves a device for as long as a button is held"
        )
    wish = parse_jog(device, motion or [])
    lifted = lift or []
    with (
        Cell.open(config, sim=sim, seed=seed, level=level.value, job=job, only=needed_for(wish, lifted)) as cell,
        cell.maintenance(reason, lifted) if lifted else nullcontext(),
    ):
        result = perform(cell, wish, job, tell_question)
    if json:
        print_json(result)
    else:
        typer.echo("  ".join(f"{name} {value}" for name, value in result.items()))


def home(
    device: Annotated[
        str | None,
        typer.Argument(help="rail or arm alone; without it both.", autocompletion=options.among("rail", "arm")),
    ] = None,
    config: ConfigOption = None,
    sim: options.SimOption = None,
    seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal,
) -> None:
    """Home the rail and bring the arm to its folded posture above the deck."""
    from cell.apps.cli.progress import tell_question
    from cell.config.cell_config import DEVICES
    from cell.run.session.supervisor import HOMED, Cell

    if device not in (None, *HOMED):
        raise ConfigError(f"cannot home {device!r}; write `cell home`, or {' or '.join(HOMED)} behind it")
    needed = tuple(DEVICES) if device is None else HOMED[device]
    with Cell.open(config, sim=sim, seed=seed, level=level.value, only=needed) as cell:
        cell.home(device, tell_question)
    typer.echo({"rail": "rail homed", "arm": "arm folded"}.get(device or "", "rail homed, arm folded"))


def recover(
    by: Annotated[str | None, typer.Option(help="Who has looked; without it, a terminal asks.")] = None,
    config: ConfigOption = None,
    sim: options.SimOption = None,
    seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal,
) -> None:
    """Clear a fault while nothing runs: unlock the arm's protective stop, clear the vehicle's fault. Nothing moves.

    You decide, not a program: look at the cell first.
    """
    import getpass
    import sys

    if not (by or "").strip():
        if by is not None or not sys.stdin.isatty():
            raise ConfigError("a person has to look at the cell first: say who has, with --by NAME")
        if not typer.confirm("Have you looked at the cell, and is the way of the arm clear?"):
            raise typer.Exit(EXIT_FAILED)
    from cell.apps.cli.progress import tell_question
    from cell.run.session.supervisor import HOMED, Cell

    with Cell.open(config, sim=sim, seed=seed, level=level.value, only=HOMED["arm"]) as cell:
        cell.recover(by or getpass.getuser(), tell_question)
    typer.echo("recovered: arm and vehicle can move again")


def diag(
    device: Annotated[
        list[str] | None,
        typer.Option(
            "--device", "-d", help="Only this device; may be given more than once.", autocompletion=options.devices
        ),
    ] = None,
    config: ConfigOption = None,
    sim: options.SimOption = None,
    seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal,
    speed: options.SpeedOption = 1.0,
    json: JsonOption = False,
) -> None:
    """Ask the devices how they are: identity, state, errors, figures with their limits. Exit code 1 if any is not well.

    Looks only: nothing on a device is set, started or ended.
    """
    from cell.devices.diagnosis.diagnosis import diagnose

    rows = diagnose(config, device or (), sim=sim, seed=seed, level=level.value, speed=speed)
    if json:
        print_json({row.device: row.as_dict() for row in rows})
    else:
        _print_table(rows)
    if not all(row.ok for row in rows):
        raise typer.Exit(1)


def find(
    ports: Annotated[
        list[str] | None, typer.Argument(help="Ask these serial ports for a TMCL module's version.")
    ] = None,
    ask: Annotated[bool, typer.Option("--ask", help="Ask every serial port that was found and is free.")] = False,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """List what answers here, and what to write into cell.toml for it. Exit code 1 if nothing can be used.

    Serial ports, CAN interfaces and cameras of this computer, and the addresses that are configured. No broadcast is
    sent, nothing moves, and no port is opened that is not asked.
    """
    from cell.devices.diagnosis.finding import NEXT
    from cell.devices.diagnosis.finding import find as look

    found = look(config, ports or (), ask=ask)
    if json:
        print_json([row._asdict() for row in found])
    else:
        _print_found(found)
        local = [row for row in found if not row.what.startswith("config")]
        for line in () if local else ("nothing was found on this computer; check", *NEXT):
            typer.echo(line)
    if not any(row.ok for row in found):
        raise typer.Exit(1)


def _print_found(found: list[Found]) -> None:
    if not found:
        return
    from rich.text import Text

    table = new_table(None, "what", "where", "state", "for cell.toml", show_lines=True)
    for row in found:
        table.add_row(row.what, row.where, Text(row.state, style="" if row.ok else "red"), Text(row.write))
    wide_console().print(table)


def devices(json: JsonOption = False) -> None:
    """List the makes of devices that `driver = "…"` can name, where each comes from, and what is wrong with it."""
    from cell.makes import installed

    rows = installed()
    if json:
        print_json([asdict(row) for row in rows])
        return
    from rich.text import Text

    table = new_table(None, "kind", "driver", "source", "state")
    for row in rows:
        table.add_row(row.kind, row.make, row.source, Text(row.state, style="" if row.ok else "red"))
    wide_console().print(table)


def doctor(config: ConfigOption = None, json: JsonOption = False) -> None:
    """Look whether this computer is fit for the cell: packages, room, clocks, ports, CAN, libraries, a browser.

    Touches no device. Exit code 1 when something is wrong that the configured cell needs; what mends it is beside it.
    """
    from cell.apps.doctor import examine_computer

    rows = examine_computer(config)
    if json:
        print_json([row._asdict() for row in rows])
    else:
        from rich.text import Text

        colours = {"ok": "green", "wrong": "red", "not needed": "dim"}
        table = new_table(None, "what", "state", "found", "what mends it")
        table.columns[1].no_wrap = True
        for row in rows:
            table.add_row(Text(row.what), Text(row.state, style=colours[row.state]), Text(row.found), Text(row.mend))
        wide_console().print(table)
    if any(row.state == "wrong" for row in rows):
        raise typer.Exit(1)


def _print_table(rows: list[Diagnosis]) -> None:
    from rich.console import Console

    console = Console()
    columns = ("device", "identity", "address", ">ms p50\np99", "errors", "state")
    table = new_table("devices", *columns, show_lines=True)
    for row in rows:
        mark = "[green]ok[/]" if row.ok else "[red]fails[/]"
        mark += "\n[yellow]simulated[/]" if row.simulated else ""
        identity = "\n".join(part for part in (row.model, row.serial, row.firmware) if part)
        times = "\n".join("" if ms is None else f"{ms:.2f}" for ms in (row.p50_ms, row.p99_ms))
        errors = ", ".join(f"{name} {count}" for name, count in sorted(row.errors.items())) or "none"
        cells = f"{row.device}\n{mark}", identity, row.address, times, errors, row.state
        table.add_row(*cells)
    console.print(table)
    _print_figures(console, rows)


def _print_figures(console: Console, rows: list[Diagnosis]) -> None:
    from cell.apps.commission.check import bounds

    columns = ("device", "figure", ">value", "unit", ">allowed", "")
    figures = new_table("figures and what they may be", *columns)
    outside: list[str] = []
    for row, reading in ((each, reading) for each in rows for reading in each.readings):
        value, allowed = f"{reading.value:.4g}", bounds(reading)
        mark = "[green]ok[/]" if reading.ok else "[red]outside[/]"
        cells = row.device, reading.what, value, reading.unit, allowed, mark if allowed else ""
        figures.add_row(*cells)
        if not reading.ok:
            told = f"{row.device}, {reading.what} {value} {reading.unit}, allowed {allowed}"
            outside.append(f"{told}: {reading.remedy}")
    if figures.row_count:
        console.print(figures)
    for line in outside:
        console.print(line, style="red", markup=False, soft_wrap=True)

"""`cell doctor`: what is wrong with this computer, and the command that mends it."""

from __future__ import annotations

import typer

from cell.apps.cli.options import ConfigOption, JsonOption, print_json, wide_console


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(doctor)


def doctor(config: ConfigOption = None, json: JsonOption = False) -> None:
    """Look whether this computer is fit for the cell: packages, room, clocks, ports, CAN, libraries, a browser.

    Touches no device. Exit code 1 when something is wrong that the configured cell needs; what mends it is beside it.
    """
    from cell.apps.doctor import examine_computer

    rows = examine_computer(config)
    if json:
        print_json([row.as_dict() for row in rows])
    else:
        from rich.table import Table
        from rich.text import Text

        colours = {"ok": "green", "wrong": "red", "not needed": "dim"}
        table = Table(show_lines=False)
        for name in ("what", "state", "found", "what mends it"):
            table.add_column(name, overflow="fold", no_wrap=name == "state")
        for row in rows:
            table.add_row(Text(row.what), Text(row.state, style=colours[row.state]), Text(row.found), Text(row.mend))
        wide_console().print(table)
    if any(row.state == "wrong" for row in rows):
        raise typer.Exit(1)

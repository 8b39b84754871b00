"""`cell watch`: live positions, limits, switches and safety state, read only."""

from __future__ import annotations

from typing import Annotated

import typer

from cell.apps.cli.options import ConfigOption

EVERY_S = 0.2
SETTLE_S = 1.0
"""How long a single look waits for the devices' first words."""


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(watch)


def watch(
    config: ConfigOption = None,
    whole: Annotated[
        bool,
        typer.Option(
            "--all", help="Also what has one user only, such as a rail: nobody else can use it until this ends."
        ),
    ] = False,
    once: Annotated[bool, typer.Option("--once", help="Look once, print it and end.")] = False,
) -> None:
    """Show where the devices are, their limits, switches and safety state, and what runs; until Ctrl-C.

    Read only, also while another process runs the cell: nothing is set, started or ended.
    """
    import sys
    import time

    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from cell.apps.watch import watching
    from cell.config.cell_config import beside, find_config, load_config

    source = find_config(config, simulated=True)
    loaded = load_config(source)
    console = Console(highlight=False)
    with watching(loaded, beside(source) / loaded.cell.runs, whole, source is not None) as cell:
        if once or not sys.stdout.isatty():
            cell.lines()
            time.sleep(SETTLE_S)
            for line in cell.lines():
                console.print(line, markup=False, soft_wrap=True)
            return
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                told = "\n".join([*cell.lines(), "", "Ctrl-C leaves"])
                live.update(Text(told, no_wrap=True, overflow="ellipsis"), refresh=True)
                time.sleep(EVERY_S)

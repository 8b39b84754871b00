"""`cell console`: the operator's screen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.apps.cli.options import ConfigOption, JobOption, Level, LevelOption, SeedOption, SimOption
from drivers.errors import CellError, ConfigError
from statemachine.watch import SignalWatch

if TYPE_CHECKING:
    from cell.apps.console.host.console import Address
    from cell.run.job_run import Observer, RunOutcome
    from cell.run.session.supervisor import Cell

NoOpenOption = Annotated[bool, typer.Option("--no-open", help="Do not open the page; its link is printed.")]
PortOption = Annotated[int, typer.Option("--port", min=0, max=65535, help="Where the page is; 0 is any that is free.")]


def console(
    config: ConfigOption = None,
    sim: SimOption = None,
    seed: SeedOption = 1,
    level: LevelOption = Level.nominal,
    job: JobOption = "pot",
    speed: Annotated[
        float | None,
        typer.Option("--speed", min=0.1, max=20, help="How many times faster than the wall a simulated cell runs."),
    ] = None,
    port: PortOption = 0,
    no_open: NoOpenOption = False,
    host: Annotated[
        str, typer.Option("--host", help="Another address than this computer's own; needs the four options below.")
    ] = "127.0.0.1",
    name: Annotated[list[str] | None, typer.Option("--name", help="What browsers call this computer there.")] = None,
    token_file: Annotated[
        Path | None, typer.Option("--token-file", help="A file with the token that opens it.")
    ] = None,
    certificate: Annotated[Path | None, typer.Option("--certificate", help="Certificate for TLS, PEM.")] = None,
    key: Annotated[Path | None, typer.Option("--key", help="Its key, PEM.")] = None,
) -> None:
    """Open the cell and show it in a browser: see it, run jobs, jog by holding a button, stop it.

    It is held until Ctrl-C. One page holds it at a time, any page stops it. STOP there is not an emergency stop.
    """
    from cell.apps.console.host.console import Address
    from cell.config.cell_config import DEVICES
    from cell.devices.simulated.mixed import simulated_of
    from cell.run.session.supervisor import Cell

    require_installed()
    address = Address(host, port, tuple(name or ()), token_file=token_file, certificate=certificate, key=key)
    address.checked()
    # At the wall's pace unless told otherwise: a person holds the buttons.
    pace = speed if speed is not None else 1.0 if set(simulated_of(sim, config)) == set(DEVICES) else None
    with Cell.open(config, sim=sim, seed=seed, level=level.value, job=job, speed=pace) as cell:
        ended = shown(cell, job, address, open_page=not no_open)
    raise typer.Exit(ended)


def require_installed() -> None:
    """`ConfigError` where the packages of the console are missing."""
    from importlib.util import find_spec

    if missing := [name for name in ("starlette", "uvicorn", "websockets") if find_spec(name) is None]:
        raise ConfigError(f"the page's server needs {', '.join(missing)}; in the checkout: pip install -e '.[console]'")


def shown(cell: Cell, job: str, address: Address, *, open_page: bool) -> int:
    """Show a cell until Ctrl-C: 0, or 130 where that cuts short what goes on. Until the server ends: stopped, and 1."""
    import threading

    from cell.apps.console.host.console import Console

    gone = threading.Event()
    with SignalWatch() as signals, Console(cell, job, address, page_notifier(open_page), gone.set):
        while signals.reason is None and not gone.wait(0.2):
            pass
        if gone.is_set():
            typer.echo("the page's server has ended, so nobody sees the cell any more: it is stopped", err=True)
        code = 1 if gone.is_set() else 0 if cell.current is None else 130
        _stop(cell)
    return code


def run_shown(
    cell: Cell, display: Observer, *, job: str, inject: Sequence[str], until: str | None, port: int, open_page: bool
) -> RunOutcome:
    """Run a job and show it, and until its pages are closed what it was; on the virtual clock computed first."""
    import time

    from cell.apps.console.host.console import Address, Console

    virtual = cell.simulated is not None and cell.simulated.facts["clock"] == "virtual"
    with Console(cell, job, Address(port=port), page_notifier(open_page)) as console:
        with console.computing(job) if virtual else nullcontext() as done:
            outcome = cell.run(job, display, inject, until=until, script=console.script(job))
            if done is not None:
                done(outcome)
        with SignalWatch() as signals:
            while signals.reason is None and console.seen:
                time.sleep(0.2)
            _stop(cell)
    return outcome


def _stop(cell: Cell) -> None:
    """Before anything is waited for: the page's server may hang."""
    try:
        cell.stop()
    except CellError as error:
        typer.echo(str(error), err=True)


def page_notifier(open_page: bool) -> Callable[[str], None]:
    """What is done with each new link: printed, and the first one opened."""
    told: list[str] = []

    def notify(link: str) -> None:
        typer.echo(
            f"the cell's page, for one browser: {link}" if not told else f"for another browser: {link}", err=True
        )
        if not told and open_page:
            open_unseen(link)
        told.append(link)

    return notify


def open_unseen(link: str) -> None:
    """Open a link in the browser. Everybody on this computer sees a process's arguments, so these name a file that
    nobody else may read, and that goes on to the link; it is removed when this program ends."""
    import atexit
    import shutil
    import tempfile
    import webbrowser

    folder = Path(tempfile.mkdtemp(prefix="cell-console-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    page = folder / "open.html"
    page.touch(0o600)
    page.write_text(f'<!doctype html><meta http-equiv="refresh" content="0;url={link}">\n', encoding="utf-8")
    webbrowser.open(page.as_uri())

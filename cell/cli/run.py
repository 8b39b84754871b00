"""`cell run`, `dry-run`, `abort`, `runs`, `report`: jobs and what became of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.options import (
    ConfigOption,
    JobOption,
    JsonOption,
    Level,
    LevelOption,
    SeedOption,
    print_json,
)  # fmt: skip

if TYPE_CHECKING:
    from cell.job_run import Observer, RunOutcome

RunArgument = Annotated[str | None, typer.Argument(help="A run's folder, name or id. Without it, the newest.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(run)
    app.command("dry-run")(dry_run)
    app.command()(resume)
    app.command()(abort)
    app.command()(runs)
    app.command()(report)


def run(job: JobOption = "pot", config: ConfigOption = None, json: JsonOption = False) -> None:
    """Run a job on the cell that the configuration describes."""
    from cell.supervisor import Cell
    from drivers.errors import ConfigError

    if config is None:
        raise ConfigError(
            "`cell run` moves real devices and needs --config; `cell init` writes one, `cell dry-run` simulates"
        )
    with Cell.open(config) as cell:
        code = _perform(lambda display: cell.run(job, display), json)
    raise typer.Exit(code)


def dry_run(
    job: JobOption = "pot",
    config: ConfigOption = None,
    seed: SeedOption = 1,
    level: LevelOption = Level.nominal,
    speed: Annotated[
        float | None, typer.Option("--speed", min=0.1, max=20, help="How many times faster than the wall.")
    ] = None,
    inject: Annotated[
        list[str] | None,
        typer.Option("--inject", help='A scheduled fault, such as "arm.protective_stop@laser_sweep:40%"; repeatable.'),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Run a job on a simulated cell, which is started and ended by itself. Calibrates it first if need be."""
    from cell.config import load_config
    from cell.injection import Injection
    from cell.job import load_job, require_fit
    from cell.supervisor import SIM_SPEED, Cell

    loaded, _ = load_job(job)
    require_fit(loaded, load_config(config))
    for text in inject or ():
        Injection.parse(text)
    with Cell.open(
        config,
        sim="all",
        seed=seed,
        level=level.value,
        speed=speed or SIM_SPEED,
        surface=Path(loaded.surface.mesh).stem,
    ) as cell:
        code = _perform(lambda display: cell.run(job, display, inject or ()), json)
    raise typer.Exit(code)


def resume(name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Go on with a run that was aborted, faulted or cut short: its job again, without sweeping what still holds.

    A dry run's world has ended with it: its job is done again in the same simulated world from the start.
    """
    from cell.job import load_job
    from cell.resumption import UnfinishedRun
    from cell.runs import find_run
    from cell.supervisor import SIM_SPEED, Cell
    from drivers.errors import ConfigError

    before = UnfinishedRun.find(find_run(_runs_folder(config), name))
    simulated = before.info["simulated"]
    if not simulated and config is None:
        raise ConfigError(f"run {before.folder.name} moved real devices: `cell resume` needs their --config")
    with Cell.open(
        config,
        sim="all" if simulated else None,
        seed=before.info["seed"] if simulated else 1,
        level=before.info["level"] if simulated else "nominal",
        speed=before.info["speed"] if simulated else SIM_SPEED,
        surface=Path(load_job(before.job)[0].surface.mesh).stem if simulated else "pot",
    ) as cell:
        code = _perform(lambda display: cell.resume(before.folder, display), json)
    raise typer.Exit(code)


def _perform(work: Callable[[Observer], RunOutcome], json: bool) -> int:
    from cell.cli.display import ProgressDisplay, print_report

    with ProgressDisplay() as display:
        outcome = work(display)
    if json:
        print_json(outcome.report)
    else:
        print_report(outcome.report, str(outcome.folder))
    return outcome.exit_code


def abort(
    name: RunArgument = None,
    config: ConfigOption = None,
    reason: Annotated[str, typer.Option(help="Goes into the report.")] = "asked for with `cell abort`",
) -> None:
    """End a run that is going on in another process: it stops the cell and reports `aborted`."""
    from cell.runs import find_run
    from drivers.errors import ConfigError
    from statemachine.journal import JournalError, read, request

    folder = find_run(_runs_folder(config), name)
    try:
        if read(folder).finished:
            raise ConfigError(f"run {folder.name} has ended already; there is nothing to abort")
        request(folder, "abort", reason)
    except JournalError as error:
        raise ConfigError(str(error)) from error
    typer.echo(f"asked run {folder.name} to end")


def runs(config: ConfigOption = None, json: JsonOption = False) -> None:
    """List the runs, newest last."""
    from cell.runs import list_runs, read_report

    rows = [{"run": folder.name, **read_report(folder)} for folder in list_runs(_runs_folder(config))]
    keys = ("run", "outcome", "job", "seed", "level", "reason")
    if json:
        print_json([{key: row.get(key) for key in keys} for row in rows])
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(*keys)
    for row in rows:
        table.add_row(*("" if row.get(key) is None else str(row.get(key)) for key in keys))
    Console().print(table)


def report(name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Show the report of a run."""
    from cell.cli.display import print_report
    from cell.runs import find_run, read_report

    folder = find_run(_runs_folder(config), name)
    data = read_report(folder)
    if json:
        print_json(data)
    else:
        print_report(data, str(folder))


def _runs_folder(config: Path | None) -> Path:
    from cell.config import load_config

    folder = Path.cwd() if config is None else config.resolve().parent
    return folder / load_config(config).cell.runs

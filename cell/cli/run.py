"""`cell run`, `dry-run`, `abort`, `runs`, `report`: jobs and what became of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cell.cli.options import (
    CellClock,
    ConfigOption,
    Confirm,
    JobOption,
    JsonOption,
    Level,
    LevelOption,
    SeedOption,
    print_json,
)  # fmt: skip

if TYPE_CHECKING:
    from cell.run.job_run import Observer, RunOutcome
    from cell.supervisor import Cell

RunArgument = Annotated[str | None, typer.Argument(help="A run's folder, name or id. Without it, the newest.")]
NoiseOption = Annotated[
    bool, typer.Option("--noise", help="Also show the noise that is assumed, and how several sweeps agree.")
]

UntilOption = Annotated[str | None, typer.Option(help="End the run, done, after the step of this name.")]
AtStartOption = Annotated[
    bool, typer.Option("--at-start", help="The vehicle stands at the job's start pose: somebody has looked.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(run)
    app.command("dry-run")(dry_run)
    app.command()(resume)
    app.command()(abort)
    app.command()(pause)
    app.command("go-on")(go_on)
    app.command()(confirm)
    app.command()(runs)
    app.command()(report)


def run(
    job: JobOption = "pot",
    config: ConfigOption = None,
    at_start: AtStartOption = False,
    until: UntilOption = None,
    json: JsonOption = False,
    noise: NoiseOption = False,
) -> None:
    """Run a job on the cell that the configuration describes.

    The vehicle drives only when it is known where it stands: it sees the board, or somebody says --at-start.
    """
    from cell.supervisor import Cell

    def perform(cell: Cell, display: Observer) -> RunOutcome:
        return cell.run(job, display, at_start=at_start, until=until)

    _perform(lambda: Cell.open(config), perform, json, noise)


def dry_run(
    job: JobOption = "pot",
    config: ConfigOption = None,
    seed: SeedOption = 1,
    level: LevelOption = Level.nominal,
    speed: Annotated[
        float | None, typer.Option("--speed", min=0.1, max=20, help="How many times faster than the wall.")
    ] = None,
    clock: Annotated[
        CellClock, typer.Option(help='"virtual": without wires and without waiting; the same seed, the same bytes.')
    ] = CellClock.wall,
    inject: Annotated[
        list[str] | None,
        typer.Option("--inject", help='A scheduled fault, such as "arm.protective_stop@laser_sweep:40%"; repeatable.'),
    ] = None,
    confirm: Annotated[
        Confirm | None,
        typer.Option(help='"simulated": the dry run confirms by itself what a person has to; else `cell confirm`.'),
    ] = None,
    until: UntilOption = None,
    json: JsonOption = False,
    noise: NoiseOption = False,
) -> None:
    """Run a job on a simulated cell, which is started and ended by itself. Calibrates it first if need be."""
    from cell.check.fit import require_fit
    from cell.config import find_config, load_config
    from cell.devices.injection import Injection
    from cell.job import load_job
    from cell.steps.kinds import find_kind
    from cell.supervisor import Cell

    loaded, mesh = load_job(job)
    require_fit(loaded, load_config(find_config(config, simulated=True)), mesh, calibrates=True)
    find_kind(loaded.job.kind).until(until)
    for text in inject or ():
        Injection.parse(text, find_kind(loaded.job.kind).names)
    opened = partial(
        Cell.open,
        config,
        sim="all",
        seed=seed,
        level=level.value,
        speed=speed,
        job=job,
        confirm=None if confirm is None else confirm.value,
        clock=clock.value,
    )
    _perform(opened, lambda cell, display: cell.run(job, display, inject or (), until=until), json, noise)


def resume(
    name: RunArgument = None,
    config: ConfigOption = None,
    at_start: AtStartOption = False,
    json: JsonOption = False,
    noise: NoiseOption = False,
) -> None:
    """Go on with a run that was aborted, faulted or cut short: its job again, without sweeping what still holds.

    A dry run's world has ended with it: its job is done again in the same simulated world from the start.
    """
    from cell.run.folder import find_run
    from cell.run.resumption import UnfinishedRun
    from cell.supervisor import Cell

    before = UnfinishedRun.find(find_run(_runs_folder(config), name, "job"))
    simulated, clock = before.info["simulated"], before.info.get("clock", "wall")
    opened = partial(
        Cell.open,
        config,
        sim="all" if simulated else None,
        seed=before.info["seed"] if simulated else 1,
        level=before.info["level"] if simulated else "nominal",
        speed=before.info["speed"] if simulated and clock == "wall" else None,
        job=before.job if simulated else "pot",
        clock=clock,
    )
    _perform(opened, lambda cell, display: cell.resume(before.folder, display, at_start=at_start), json, noise)


def _perform(
    opened: Callable[[], Cell], work: Callable[[Cell, Observer], RunOutcome], json: bool, noise: bool
) -> NoReturn:
    """Do a job on a cell, show how it ended, and exit with its code: 130 also for a signal after its end."""
    from cell.cli import EXIT_INTERRUPTED
    from cell.cli.display import ProgressDisplay, print_late, print_report
    from statemachine.watch import SignalInterrupt

    outcome = None
    try:
        with opened() as cell:
            with ProgressDisplay() as display:
                outcome = work(cell, display)
            if json:
                print_json(outcome.report)
            else:
                print_report({**outcome.report, "wall_s": outcome.wall_s}, str(outcome.folder), noise=noise)
        code = outcome.exit_code
    except SignalInterrupt:
        if outcome is None:
            raise
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED and outcome.outcome != "aborted":
        print_late(outcome.report)
    raise typer.Exit(code)


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

    from cell.cli import EXIT_FAILED
    from cell.run.reading import awaited_word
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
    _ask(str(folder), config, "confirm", by or getpass.getuser(), answer, waits.number)


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
    from cell.cli.display import print_runs
    from cell.run.folder import list_runs
    from cell.run.reading import run_row

    rows = [run_row(folder) for folder in list_runs(_runs_folder(config))]
    if json:
        print_json(rows)
    else:
        print_runs(rows)


def report(
    name: RunArgument = None, config: ConfigOption = None, json: JsonOption = False, noise: NoiseOption = False
) -> None:
    """Show the report of a run."""
    from cell.cli.display import print_report
    from cell.run.folder import find_run
    from cell.run.reading import read_report

    folder = find_run(_runs_folder(config), name)
    data = read_report(folder)
    if json:
        print_json(data)
    else:
        print_report(data, str(folder), noise=noise)


def _runs_folder(config: Path | None) -> Path:
    from cell.config import beside, find_config, load_config

    path = find_config(config, simulated=True)
    return beside(path) / load_config(path).cell.runs


def _going_folder(config: Path | None) -> Path:
    """As `_runs_folder`, for who ends or holds what goes on: the configuration may have become wrong meanwhile."""
    from cell.config import find_config, runs_folder

    return runs_folder(find_config(config, simulated=True))

"""`cell run`, `dry-run`, `resume`: jobs, from their beginning to their end."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cell.apps.cli import options
from cell.apps.cli.commands.runs import NoiseOption, RunArgument, folder_of_runs
from cell.apps.cli.options import CellClock, ConfigOption, Confirm, JobOption, JsonOption, Level, print_json
from drivers.errors import ConfigError
from sim_backends.faults import FAULT_NAMES

if TYPE_CHECKING:
    from cell.config.cell_config import CellConfig
    from cell.config.job import Job
    from cell.run.batch import BatchOutcome
    from cell.run.job_run import Observer, RunOutcome
    from cell.run.session.supervisor import Cell
    from statemachine.step import Event

UntilOption = Annotated[
    str | None, typer.Option(help="Stop after this step; the run then ends done.", autocompletion=options.steps)
]
CountOption = Annotated[
    int | None, typer.Option("--count", help="Run a batch: this many parts, 1 to 10000, or rounds of items.")
]
AtStartOption = Annotated[
    bool, typer.Option("--at-start", help="The vehicle stands at the job's start pose: somebody has looked.")
]
SpeedOption = Annotated[
    float | None, typer.Option("--speed", min=0.1, max=20, help="How many times faster than the wall.")
]
ClockOption = Annotated[
    CellClock | None,
    typer.Option(
        help='"virtual": without wires and without waiting; the same seed, the same bytes. "wall" unless something '
        "is missing to speak with a device."
    ),
]
InjectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--inject",
        help='A scheduled fault, such as "arm.protective_stop@laser_sweep:40%"; repeatable. What can be '
        f"injected, not named as the codes that are reported: {', '.join(FAULT_NAMES)}.",
        autocompletion=options.faults,
    ),
]
ConfirmOption = Annotated[
    Confirm | None,
    typer.Option(help='"simulated": the dry run confirms by itself what a person has to; else `cell confirm`.'),
]
ConsoleOption = Annotated[
    bool, typer.Option("--console", help="Show it in a browser, until its page is closed; or, with --no-open, ended.")
]


def run(
    job: JobOption = "pot",
    config: ConfigOption = None,
    at_start: AtStartOption = False,
    until: UntilOption = None,
    sim: options.SimOption = None,
    seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal,
    pace: Annotated[
        float, typer.Option("--pace", help="Arm and vehicle at this share of their planned speed, 0.25 to 1.")
    ] = 1.0,
    json: JsonOption = False,
    noise: NoiseOption = False,
    count: CountOption = None,
    elsewhere: Annotated[bool, typer.Option("--ask-elsewhere", help="With --count: `cell confirm` answers.")] = False,
) -> None:
    """Run a job on the cell that the configuration describes.

    The vehicle drives only when it is known where it stands: it sees the board, or somebody says --at-start.
    """
    from cell.config.job import item_names
    from cell.procedures.arm.moves import require_share
    from cell.run.session.supervisor import Cell

    def perform(cell: Cell, display: Observer) -> RunOutcome:
        cell.pace = pace
        return cell.run(job, display, at_start=at_start, until=until)

    require_share(pace)
    _say_qualified(job, config)
    if count is None and len(item_names(job)) > 1:
        count = 1
    opened = partial(Cell.open, config, sim=sim, seed=seed, level=level.value, job=job)
    if elsewhere and count is None:
        raise typer.BadParameter("--ask-elsewhere is for the questions of a batch: give --count too, or leave it out")
    if count is not None:
        batch = partial(Cell.run_batch, job=job, at_start=at_start)
        _perform_batch(opened, batch, count, json, partly=until is not None, elsewhere=elsewhere, pace=pace)
    _perform(opened, perform, json, noise)


def dry_run(
    job: JobOption = "pot", config: ConfigOption = None, seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal, speed: SpeedOption = None, clock: ClockOption = None,
    inject: InjectOption = None, confirm: ConfirmOption = None, until: UntilOption = None, json: JsonOption = False,
    noise: NoiseOption = False, console: ConsoleOption = False,
    no_open: Annotated[bool, typer.Option("--no-open", help="With --console: print the page's link only.")] = False,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="With --console: where the page is.")] = 0,
    count: CountOption = None,
) -> None:  # fmt: skip
    """Run a job on a simulated cell, which is started and ended by itself. Calibrates it first if need be."""
    typer.echo(f"dry run of {job} in the simulated world {seed}: loading", err=True)
    from cell.check.fit import read_fitting
    from cell.config.cell_config import find_config, load_config
    from cell.config.job import item_names
    from cell.devices.simulated.process import Injection
    from cell.procedures.steps.kinds import kind_of
    from cell.run.session.supervisor import Cell

    if count is None and len(item_names(job)) > 1:
        count = 1
    described = load_config(find_config(config, simulated=True))
    loaded, _ = read_fitting(job, described, calibrates=True)
    if clock is None and speed is None:
        clock = _clock(described)
    kind_of(loaded).until(until)
    for text in inject or ():
        Injection.parse(text, kind_of(loaded).names)
    _say_qualified(job, config)
    opened = partial(
        Cell.open, config, sim="all", seed=seed, level=level.value, speed=speed, job=job,
        confirm=confirm, clock=clock or "wall",
    )  # fmt: skip
    if count is not None:
        _require_terminal(loaded, confirm)
        batch = partial(Cell.run_batch, job=job, inject=inject or ())
        _perform_batch(opened, batch, count, json, partly=console or until is not None)
    if console:
        from cell.apps.cli.commands.console import require_installed, run_shown

        require_installed()
        watched = partial(run_shown, job=job, inject=inject or (), until=until, port=port, open_page=not no_open)
        _perform(opened, watched, json, noise)
    _perform(opened, lambda cell, display: cell.run(job, display, inject or (), until=until), json, noise)


def _say_qualified(job: str, config: Path | None) -> None:
    """Tell in a line how well `cell qualify` found this job to work, where it did."""
    from cell.apps.qualify.answer import kept_line

    if (line := kept_line(job, config)) is not None:
        typer.echo(line, err=True)


def _perform_batch(
    opened: Callable[[], Cell], batch: Callable[..., BatchOutcome], count: int, json: bool, *, partly: bool,
    elsewhere: bool = False, pace: float = 1.0,
) -> NoReturn:  # fmt: skip
    """Do a batch on a cell, show what came of it, exit with its code. A person is asked here, unless `elsewhere`."""
    from cell.apps.cli.display import print_batch
    from cell.apps.cli.progress import ProgressDisplay, answer_here
    from cell.devices.simulated.process import is_whole
    from cell.run.batch import require_count

    require_count(count)
    if partly:
        raise ConfigError(
            "a batch does whole jobs, shown here: leave out --until and --console, or name one item, such as tray4#2"
        )
    with ProgressDisplay(compiles=True) as display, opened() as cell:
        # The system stops a process in the background that reads the terminal.
        here = not elsewhere and _at_terminal()
        if not (here or elsewhere or is_whole(cell.simulated)):
            raise ConfigError(
                "there is no terminal to ask whether the next part is in the claw: run this in one, or add "
                "--ask-elsewhere and answer with `cell confirm`"
            )

        def notify(event: Event) -> None:
            display(event)
            if here and event.kind == "confirm_needed" and (run := cell.current) is not None and run.kind == "loading":
                answer_here(run.control, display.console)

        cell.pace = pace
        outcome = batch(cell, count=count, observer=notify)
        display.end()
        print_json(outcome.as_dict()) if json else print_batch(outcome)
    raise typer.Exit(outcome.exit_code)


def _require_terminal(job: Job, confirm: Confirm | None) -> None:
    """Refuse a batch that would ask a person, and wait for ever, where nobody is."""
    if job.batch.on_refusal == "ask" and confirm != "simulated" and not _at_terminal():
        raise typer.BadParameter(
            f'batch.on_refusal of job {job.job.name} is "ask", and there is no terminal to ask at: add --confirm '
            'simulated, or write "end" or "skip"'
        )


def _at_terminal() -> bool:
    """Whether this program may read what is typed: it is at a terminal, and in its foreground."""
    try:
        return sys.stdin.isatty() and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:
        return False


def _clock(config: CellConfig) -> CellClock:
    """The wall's time, or the virtual one, said so, where something is missing to speak with the devices."""
    from cell.config.cell_config import DEVICES

    missing = (f"{name}: {why}" for name in DEVICES if (why := config.make(name).missing()))
    if why := next(missing, ""):
        typer.echo(f"this dry run is on the virtual clock, without the devices' protocols. {why}", err=True)
    return "virtual" if why else "wall"


def resume(
    name: RunArgument = None, config: ConfigOption = None, at_start: AtStartOption = False, json: JsonOption = False,
    noise: NoiseOption = False,
) -> None:  # fmt: skip
    """Run the job of an aborted, faulted or cut-short run again. A sweep that still holds is not repeated.

    A dry run's world has ended with it: its job is done again in the same simulated world from the start.
    """
    from cell.run.folder import find_run
    from cell.run.resumption import UnfinishedRun
    from cell.run.session.supervisor import Cell

    before = UnfinishedRun.find(find_run(folder_of_runs(config), name, "job"))
    simulated, clock, seed = before.info["simulated"], before.info.get("clock", "wall"), before.info.get("seed")
    whole = simulated is True
    opened = partial(
        Cell.open, config, sim="all" if whole else simulated or "none", seed=1 if seed is None else seed,
        level=before.info.get("level") or "nominal",
        speed=before.info.get("speed") if whole and clock == "wall" else None, job=before.job if simulated else "pot",
        clock=clock,
    )  # fmt: skip
    _perform(opened, lambda cell, display: cell.resume(before.folder, display, at_start=at_start), json, noise)


def _perform(
    opened: Callable[[], Cell], work: Callable[[Cell, Observer], RunOutcome], json: bool, noise: bool
) -> NoReturn:
    """Do a job on a cell, show how it ended, and exit with its code: 130 also for a signal after its end."""
    from cell.apps.cli import EXIT_INTERRUPTED, say_unshown
    from cell.apps.cli.display import print_late, print_report
    from cell.apps.cli.progress import ProgressDisplay
    from statemachine.watch import SignalInterrupt

    outcome = None
    try:
        with ExitStack() as shown:
            display = shown.enter_context(ProgressDisplay(compiles=True))
            cell = shown.enter_context(opened())
            outcome = work(cell, display)
            display.end()
            try:
                if json:
                    print_json(outcome.report)
                else:
                    print_report({**outcome.report, "wall_s": outcome.wall_s}, str(outcome.folder), noise=noise)
                sys.stdout.flush()
            # The library that prints ends the process where nobody reads any more.
            except (OSError, SystemExit) as error:
                say_unshown(f"run {outcome.folder.name} ended {outcome.outcome}", error)
        code = outcome.exit_code
    except SignalInterrupt:
        if outcome is None:
            raise
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED and outcome.outcome != "aborted":
        print_late(outcome.report)
    raise typer.Exit(code)

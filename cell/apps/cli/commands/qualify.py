"""`cell qualify`: a job on many simulated worlds. How often does it work, how fast, and what goes wrong first?"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.apps.cli import EXIT_FAILED, EXIT_INTERRUPTED, options
from cell.apps.cli.options import ConfigOption, JsonOption, Level, LevelOption, new_table, print_json, wide_console

if TYPE_CHECKING:
    from cell.apps.qualify.answer import JobAnswer
    from cell.apps.qualify.campaign import Campaign, Prefix, Target
    from cell.apps.qualify.page import TextTable
    from cell.apps.qualify.rows import Row, RowStore
    from cell.apps.qualify.workers import Workers

JobArgument = Annotated[
    str,
    typer.Argument(
        help="A job file, or a name: NAME.toml of the present folder, else the job that ships.",
        autocompletion=options.jobs,
    ),
]
SeedsOption = Annotated[int | None, typer.Option("--seeds", help="So many worlds, instead of --until.")]
UntilOption = Annotated[
    str | None,
    typer.Option("--until", help='"yield:±1%": until the 95 % interval of the yield is that narrow. By default ±5 %.'),
]
MostOption = Annotated[int | None, typer.Option("--most", help="With --until: at most so many. By default 2000.")]
FirstSeedOption = Annotated[int, typer.Option("--first-seed", help="The seed of the first world, 0 to 999999.")]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", help="Processes of this machine. By default one for each core.")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="The campaign's folder. By default qualify/JOB beside the configuration.")
]
SchedulerOption = Annotated[
    str | None, typer.Option("--scheduler", help="A running Dask scheduler: tcp://HOST:PORT or tls://HOST:PORT.")
]
ClusterOption = Annotated[
    str | None, typer.Option("--cluster", help='"local:N": a Dask cluster of N workers on this machine.')
]
CompareOption = Annotated[
    Path | None, typer.Option("--compare", help="The folder of another campaign, or this one with older code.")
]


def qualify(
    job: JobArgument = "pot", config: ConfigOption = None, level: LevelOption = Level.nominal,
    seeds: SeedsOption = None, until: UntilOption = None, most: MostOption = None, first_seed: FirstSeedOption = 1,
    workers: WorkersOption = None, out: OutOption = None, json: JsonOption = False, scheduler: SchedulerOption = None,
    cluster: ClusterOption = None, compare: CompareOption = None,
) -> None:  # fmt: skip
    """Run a job on many simulated worlds on the virtual clock: yield, figures beside their limits, what goes wrong.

    A campaign goes on where it was stopped. Exits 1 where a part was placed outside its tolerance unnoticed, and where
    the program failed in a world.
    """
    from cell.apps.qualify import campaign as campaigns
    from cell.apps.qualify.answer import compare as paired
    from cell.apps.qualify.answer import keep_line, other_rows
    from cell.apps.qualify.page import comparison_tables, tables_of, write_page
    from cell.apps.qualify.rows import RowStore
    from cell.apps.qualify.workers import open_workers
    from cell.config.files import find_config

    target, path = campaigns.Target.of(seeds, until, most), find_config(config, simulated=True)
    campaign = _campaign(job, path, out, level=level.value, first=first_seed, target=target)
    store = RowStore(campaign.folder)
    others = None if compare is None else other_rows(campaign, compare)
    count = _run(campaign, store, partial(open_workers, workers, scheduler, cluster))
    rows = campaign.rows(store, count)
    answer = _answer(campaign, rows, job)
    compared = None if others is None else paired(rows, others)
    more = [] if compared is None else list(comparison_tables(compared))
    page, line = write_page(campaign.folder, answer, rows, more), keep_line(answer, job, path)
    if json:
        told = answer.as_dict() | {"folder": str(campaign.folder), "page": str(page), "kept": str(line)}
        print_json(told if compared is None else {**told, "compared": asdict(compared)})
    else:
        _print([*tables_of(answer), *more], answer, page, line)
    raise typer.Exit(EXIT_FAILED if answer.unnoticed.count or "error" in answer.shares else 0)


def _campaign(job: str, path: Path | None, out: Path | None, *, level: str, first: int, target: Target) -> Campaign:
    """The campaign that was asked for. `ConfigError` where its job does not fit the cell."""
    from cell.apps.qualify.campaign import Campaign
    from cell.apps.qualify.identity import QualifiedCode
    from cell.check.fit import read_fitting
    from cell.config.cell_config import default_toml, load_config
    from cell.config.files import beside
    from cell.config.job import job_and_item, job_path

    config = load_config(path)
    read_fitting(job, config, calibrates=True)
    of, (_, number) = QualifiedCode.of(job, config), job_and_item(job)
    file = str(job_path(job).resolve()) + ("" if number is None else f"#{number}")
    text = default_toml() if path is None else path.read_text(encoding="utf-8")
    folder = (beside(path) / "qualify" / of.job.replace("#", "-")) if out is None else out.absolute()
    return Campaign(of, file, text, folder, level=level, first=first, target=target)


def _run(campaign: Campaign, store: RowStore, opened: Callable[[], Workers]) -> int:
    """Run what is missing, with a bar on standard error; how many worlds answer. Exits where it is interrupted."""
    from statemachine.watch import SignalInterrupt

    try:
        with _bar(f"{campaign.of.job}, {campaign.level}") as shown:
            return campaign.run(store, opened, shown).known
    except (SignalInterrupt, KeyboardInterrupt):
        kept = sum(seed >= campaign.first for seed in store.outcomes(**campaign.wanted))
        typer.echo(
            f"interrupted: {kept} worlds are kept in {_near(campaign.folder)}; the same command goes on", err=True
        )
        raise typer.Exit(EXIT_INTERRUPTED) from None


@contextmanager
def _bar(what: str) -> Iterator[Callable[[Prefix], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(bar_width=20), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True, speed_estimate_period=600) as progress:
        task = progress.add_task(what, total=None)

        def shown(prefix: Prefix) -> None:
            told = f"{what}: {prefix.known} worlds, yield {prefix.yields}" if prefix.known else f"{what}: 0 worlds"
            progress.update(task, completed=prefix.known, total=prefix.likely_end, description=told)

        yield shown


def _answer(campaign: Campaign, rows: Sequence[Row], job: str) -> JobAnswer:
    from cell.apps.qualify.answer import JobAnswer, repeat_command

    def command(row: Row) -> str:
        file = campaign.task(int(row["seed"] or 0)).config_file
        return repeat_command(row, job, _near(file))

    return JobAnswer.of_rows(
        campaign.of, campaign.level, first=campaign.first, rows=rows, command=command, date=time.strftime("%Y-%m-%d")
    )


def _print(tables: Sequence[TextTable], answer: JobAnswer, page: Path, line: Path) -> None:
    from rich.markup import escape

    console = wide_console(100)
    for table in tables:
        console.print(table.title, style="bold", markup=False, highlight=False, soft_wrap=True)
        shown = new_table(None, *table.columns)
        for row in table.rows:
            shown.add_row(*map(escape, row))
        console.print(shown)
    for command in list(dict.fromkeys(world.command for world in answer.worst))[:3]:
        console.print(f"repeat    {command}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"page      {_near(page)}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"kept      {_near(line)}", markup=False, highlight=False, soft_wrap=True)
    console.print(answer.line, markup=False, highlight=False, soft_wrap=True)


def _near(path: Path) -> str:
    """A path as one would type it here."""
    told = os.path.relpath(path)
    return str(path) if told.startswith("..") else told

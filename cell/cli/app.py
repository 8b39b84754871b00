"""The table of commands. Their bodies import what they need when they run, so that `cell --help` stays quick."""

from __future__ import annotations

from typing import Annotated

import typer

from cell.cli import (
    bench_acceptance,
    bench_accuracy,
    bench_board,
    bench_calibration,
    bench_endings,
    bench_inversion,
    bench_reconstruction,
    bench_stripe,
    bench_verify,
    calibrate,
    devices,
    export,
    paper,
    run,
    setup,
    sim,
)
from cell.cli.usage import App

app = App(
    name="cell",
    help="Control of a laser-guided assembly cell: drive, photograph, sweep, reconstruct, invert, place.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from cell.version import release

        typer.echo(f"cell {release()}")
        raise typer.Exit


@app.callback()
def _cell(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the release and exit.")
    ] = False,
    verbose: Annotated[
        int, typer.Option("--verbose", "-v", count=True, help="Show what happens on standard error; -vv everything.")
    ] = 0,
) -> None:
    """Options before any command."""
    from cell.logs import console_log

    console_log(verbose)


for register in (
    run.register, export.register, calibrate.register, devices.register, setup.register, paper.register,
):  # fmt: skip
    register(app)
app.add_typer(sim.app, name="sim")

bench = typer.Typer(
    help="Campaigns and comparisons: accuracy and speed, beside their bounds and peers.", no_args_is_help=True
)
for register_bench in (
    bench_acceptance.register,
    bench_accuracy.register,
    bench_board.register,
    bench_calibration.register,
    bench_endings.register,
    bench_inversion.register,
    bench_reconstruction.register,
    bench_stripe.register,
    bench_verify.register,
):
    register_bench(bench)
app.add_typer(bench, name="bench")

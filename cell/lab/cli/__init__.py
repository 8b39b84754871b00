"""The laboratory's commands, `cell bench` and `cell paper`; `cell` finds them by their entry point.

So nothing of the product imports the laboratory.
"""

from __future__ import annotations

import typer

from cell.lab.cli import (
    bench_acceptance,
    bench_accuracy,
    bench_board,
    bench_calibration,
    bench_endings,
    bench_inversion,
    bench_pages,
    bench_realism,
    bench_reconstruction,
    bench_servo,
    bench_soak,
    bench_stripe,
    bench_verify,
    paper,
)


def register(app: typer.Typer) -> None:
    """Add `cell bench` and `cell paper` to `app`."""
    bench = typer.Typer(
        help="Campaigns and comparisons: accuracy and speed, beside their bounds and peers.", no_args_is_help=True
    )
    for command in (
        bench_acceptance,
        bench_accuracy,
        bench_board,
        bench_calibration,
        bench_endings,
        bench_inversion,
        bench_pages,
        bench_realism,
        bench_reconstruction,
        bench_servo,
        bench_soak,
        bench_stripe,
        bench_verify,
    ):
        command.register(bench)
    app.add_typer(bench, name="bench")
    paper.register(app)

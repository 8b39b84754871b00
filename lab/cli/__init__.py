"""The laboratory's commands, `cell bench` and `cell paper`; `cell` finds them by their entry point.

So nothing of the product imports the laboratory.
"""

from __future__ import annotations

import typer

from lab.cli.bench_acceptance import acceptance
from lab.cli.bench_accuracy import accuracy
from lab.cli.bench_board import board
from lab.cli.bench_calibration import calibration
from lab.cli.bench_endings import endings
from lab.cli.bench_inversion import inversion
from lab.cli.bench_realism import realism
from lab.cli.bench_reconstruction import reconstruction
from lab.cli.bench_streams import pages, servo, soak
from lab.cli.bench_stripe import stripe
from lab.cli.bench_verify import verify
from lab.cli.paper import paper

BENCH = (
    acceptance, accuracy, board, calibration, endings, inversion, pages, realism, reconstruction, servo, soak, stripe,
    verify,
)  # fmt: skip


def register(app: typer.Typer) -> None:
    """Add `cell bench` and `cell paper` to `app`."""
    bench = typer.Typer(
        help="Campaigns and comparisons: accuracy and speed, beside their bounds and peers.", no_args_is_help=True
    )
    for command in BENCH:
        bench.command()(command)
    app.add_typer(bench, name="bench")
    app.add_typer(paper, name="paper")

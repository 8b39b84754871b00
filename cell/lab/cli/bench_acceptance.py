"""`cell bench acceptance`: the acceptance tests of the trade on a simulated head."""

from __future__ import annotations

import typer

from cell.cli.options import JsonOption, Level, LevelOption, SeedOption, print_json


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(acceptance)


def acceptance(seed: SeedOption = 1, level: LevelOption = Level.nominal, json: JsonOption = False) -> None:
    """Probing error, sphere spacing error and flatness after VDI/VDE 2634 part 2 and ISO 10360-13, simulated.

    A ball at ten places of the measuring volume, a ball bar at seven, a flat at six; the worst place counts.
    """
    from cell.lab.bench.acceptance import acceptance as campaign
    from cell.lab.cli.paper_tables import campaign_progress, print_acceptance

    with campaign_progress("places") as progress:
        result = campaign(seed, level.value, progress)
    if json:
        print_json(result)
    else:
        print_acceptance(result)

"""`cell bench acceptance`: the acceptance tests of the trade on a simulated head."""

from __future__ import annotations

from cell.apps.cli.options import JsonOption, Level, LevelOption, SeedOption
from lab.cli.shown import bar, show


def acceptance(seed: SeedOption = 1, level: LevelOption = Level.nominal, json: JsonOption = False) -> None:
    """Probing error, sphere spacing error and flatness after VDI/VDE 2634 part 2 and ISO 10360-13, simulated.

    A ball at ten places of the measuring volume, a ball bar at seven, a flat at six; the worst place counts.
    """
    from lab.bench.acceptance.campaign import acceptance as campaign
    from lab.cli.paper_tables import print_acceptance

    with bar() as told:
        result = campaign(seed, level.value, lambda done, total: told(done, "places", total))
    show(result, json, print_acceptance)

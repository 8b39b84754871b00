"""`cell bench verify`: how often a disturbed calibration is found, and a good one suspected."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.apps.cli.options import JsonOption, Level, LevelOption, wide_console
from lab.cli.shown import bar, counted, show, table


def verify(
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="How many worlds.")] = 20,
    level: LevelOption = Level.nominal,
    json: JsonOption = False,
) -> None:
    """Find 0.2 mm or 0.05° in every part of the chain, over many simulated worlds (no pictures are rendered)."""
    from lab.bench.calibration.verification import KINDS_OF_CHANGE, campaign, disturbances

    chosen = disturbances()
    with bar() as told:
        progress = counted(told, seeds * (len(chosen) + KINDS_OF_CHANGE + 1))
        found = campaign(range(1, seeds + 1), level.value, chosen, progress)
    show(found.summary(level.value, seeds) | {"seeds": seeds, "level": level.value}, json, _print)


def _print(summary: dict[str, Any]) -> None:
    from lab.bench.calibration.verification import CHECKS_OF_A_GOOD_ONE

    console, seeds = wide_console(150), summary["seeds"]
    keys = ("name", "checks", "found_percent", "detectable_mean", "unit", "named_first_percent",
            "among_suspects_percent")  # fmt: skip
    columns = ("disturbance", "checks", "found %", "in 95 % from", "unit", "its part named first %",
               "among the suspects %")  # fmt: skip
    rows = ([row[key] for key in keys] for row in summary["disturbances"])
    console.print(table(f"verification over {seeds} worlds, level {summary['level']}", columns, rows))
    of_size = ("part", "<change", "mean", "largest", "wanted", "unit", "checks", "found %", "bad at a third %")
    title = "changes as large as the verification says it finds in 95 % of checks"
    console.print(table(title, of_size, (row.values() for row in summary["detectable"])))
    console.print(f"found of changes of this size: {summary['found_at_detectable_percent']:g} %")
    console.print(
        f"called bad where the place is off by a third of its tolerance: {summary['bad_at_a_third_percent']:g} %"
    )
    console.print(
        f"false alarms: {summary['false_alarm_percent']:g} % of {summary['checks_of_good']} checks of good "
        f"calibrations, {CHECKS_OF_A_GOOD_ONE} per world, in {summary['calibrations_with_a_false_alarm']} of {seeds} "
        f"worlds; a change was seen in {summary['change_seen_percent']:g} %"
    )

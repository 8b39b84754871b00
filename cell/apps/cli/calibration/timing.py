"""`cell calibrate timing`: how late the scan camera's time stamps come."""

from __future__ import annotations

import typer

from cell.apps.cli.options import (  # fmt: skip
    ConfigOption,
    JobOption,
    JsonOption,
    Level,
    LevelOption,
    SeedOption,
    SimOption,
    print_json,
)


def register(group: typer.Typer) -> None:
    """Add the command of this file to `cell calibrate`."""
    group.command()(timing)


def timing(
    config: ConfigOption = None,
    sim: SimOption = None,
    seed: SeedOption = 1,
    level: LevelOption = Level.nominal,
    job: JobOption = "pot",
    json: JsonOption = False,
) -> None:
    """Sweep to and fro over the fine board on the deck and measure how late the scan camera's time stamps come.

    What is found is kept with the stored calibration and taken out of every sweep by the rail. A rolling shutter, and
    stamps that are not those of an exposure's beginning, are refused by name. Exit code 1 when it is refused.
    """
    from cell.apps.cli.progress import ProgressDisplay
    from cell.run.session.supervisor import Cell

    with Cell.open(config, sim=sim, seed=seed, level=level.value) as cell, ProgressDisplay() as display:
        found = cell.time_stamps(display, job).scan.timing
    assert found is not None
    told = found.summary()
    if json:
        print_json(told)
        return
    typer.echo(
        f"the scan camera's time stamps come {told['late_ms']:+.2f} ± {told['sigma_ms']:.2f} ms late; the carriage's "
        f"play is {told['play_um']:.0f} ± {told['play_sigma_um']:.0f} µm; rows are exposed "
        f"{told['readout_ms']:.2f} ± {told['readout_sigma_ms']:.2f} ms one after the other. Kept with the calibration"
    )

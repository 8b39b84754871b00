"""`cell calibrate solve`: an archived calibration solved again, without any device."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cell.apps.cli.options import ConfigOption, JobOption, JsonOption, print_json


def register(group: typer.Typer) -> None:
    """Add the command of this file to `cell calibrate`."""
    group.command()(solve)


def solve(
    archive: Annotated[Path, typer.Argument(help="The .observations.npz beside a stored calibration.")],
    config: ConfigOption = None,
    job: JobOption = "pot",
    json: JsonOption = False,
) -> None:
    """Solve archived observations again, and examine the result; nothing moves and nothing stored is changed.

    Without --config the cameras as drawn and the assumed noise are those of the archive, and the result is the same as
    when it was made.
    """
    from dataclasses import replace

    from cell.apps.cli.calibration.tables import print_examination
    from cell.apps.cli.display import print_calibration
    from cell.config.calibrations.store import gathered, solve_observations
    from cell.config.cell_config import find_config, load_config
    from cell.measure.calibration.archive import SUFFIX, read_archive
    from cell.procedures.calibrate.report import examine

    observations = read_archive(archive)
    loaded = load_config(find_config(config, simulated=True))
    if config is not None:
        o = observations
        again = gathered(o.scan, o.target, o.identities, config=loaded, kinematics=o.kinematics, witness=o.witness)
        observations = replace(again, made=o.made)
    solved = solve_observations(observations)
    summary = solved.calibration.summary()
    examination = examine(solved, observations, loaded, job)
    pictures = examination.draw(archive.with_name(archive.name.removesuffix(SUFFIX)))
    if json:
        print_json({**summary, **examination.summary, "pictures": [str(path) for path in pictures]})
        return
    print_calibration(summary, None)
    print_examination(examination.summary, pictures)

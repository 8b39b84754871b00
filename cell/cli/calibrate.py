"""`cell calibrate`: the cell's own calibration, or one from a folder of recorded frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cell.cli import calibrate_solve, verify
from cell.cli.options import (
    ConfigOption,
    JobOption,
    JsonOption,
    Level,
    LevelOption,
    SeedOption,
    SimOption,
    print_json,
)  # fmt: skip


def register(app: typer.Typer) -> None:
    """Add the commands of this file, and those below `cell calibrate`."""
    group = typer.Typer(invoke_without_command=True)
    group.callback()(calibrate)
    calibrate_solve.register(group)
    verify.register(group)
    app.add_typer(group, name="calibrate")


def calibrate(
    context: typer.Context,
    config: ConfigOption = None,
    sim: SimOption = None,
    seed: SeedOption = 1,
    level: LevelOption = Level.nominal,
    job: JobOption = "pot",
    source: Annotated[
        Path | None, typer.Option("--from", help="A folder of recorded frames, with flange poses or without.")
    ] = None,
    board: Annotated[
        str | None, typer.Option("--board", help='The board in the recorded frames, such as "chessboard:7x6:10mm".')
    ] = None,
    json: JsonOption = False,
) -> None:
    """Calibrate rail, cameras, hand-eye and light plane, and store the result.

    Moves the cell through its own calibration poses over the boards on its deck; with --from it moves nothing.
    """
    if context.invoked_subcommand is not None:
        return
    from drivers.errors import ConfigError

    if source is None and board is not None:
        raise ConfigError("--board belongs to --from; the boards on the deck are named in the configuration")
    if source is not None:
        _from_folder(source, board, json)
        return
    from cell.calibration.archive import read_archive
    from cell.calibration.report import examine
    from cell.calibration.store import archive_of, solve_observations
    from cell.cli.calibration_tables import print_examination
    from cell.cli.display import ProgressDisplay, print_calibration
    from cell.supervisor import Cell

    with Cell.open(config, sim=sim, seed=seed, level=level.value) as cell, ProgressDisplay() as display:
        calibration = cell.calibrate(display, job)
        where, loaded = cell.calibrations_folder, cell.config
    # The devices are free again; what follows takes the observations as they were stored.
    observations = read_archive(archive_of(where, calibration))
    examination = examine(solve_observations(observations), observations, loaded, job)
    pictures = examination.draw(where / calibration.name)
    if json:
        print_json({**calibration.summary(), **examination.summary, "pictures": [str(path) for path in pictures]})
    else:
        print_calibration(calibration.summary(), str(where))
        print_examination(examination.summary, pictures)


def _from_folder(folder: Path, board: str | None, json: bool) -> None:
    from cell.calibration.recorded.command import calibrate_folder
    from cell.cli.recorded_tables import print_recorded
    from cell.vision import parse_board
    from drivers.errors import ConfigError, RefusedError

    result = calibrate_folder(folder, None if board is None else parse_board(board))
    if json:
        print_json(result)
    else:
        print_recorded(result)
    if not any(frame["used"] for frame in result["frames"]):
        raise ConfigError(
            f"no picture in {folder} could be used: is {board} the board in the pictures? The reasons are listed above"
        )
    if result["refused"]:
        raise RefusedError("; ".join(result["refused"].values()))
    if result["intrinsics"] is None and result["hand_eye"] is None:
        raise ConfigError(f"nothing could be calibrated from {folder}: {'; '.join(result['notes'])}")

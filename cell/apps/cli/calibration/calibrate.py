"""`cell calibrate`: the cell's own calibration, or one from a folder of recorded frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.apps.cli import options
from cell.apps.cli.calibration import stored
from cell.apps.cli.options import ConfigOption, JsonOption, Level, print_json
from drivers.errors import ConfigError, RefusedError

if TYPE_CHECKING:
    from cell.apps.recordings.command import Options

SourceOption = Annotated[
    Path | None, typer.Option("--from", help="A folder of recorded frames, with flange poses or without.")
]
BoardOption = Annotated[
    str | None, typer.Option("--board", help='The board in the recorded frames, such as "chessboard:7x6:10mm".')
]
PlanOption = Annotated[
    bool, typer.Option("--plan", help="Only say what was understood of the recorded frames, and calibrate nothing.")
]
PosesOption = Annotated[
    str | None,
    typer.Option(
        "--poses", help='How the recorded poses are to be read, such as "xyz+rotvec-rad"; else the pictures tell.'
    ),
]
PoseFieldOption = Annotated[
    str | None, typer.Option("--pose-field", help="Which of several recorded poses is the flange's.")
]
SetupOption = Annotated[
    str | None, typer.Option("--setup", help="Where the camera was: eye-in-hand or eye-to-hand; else the poses tell.")
]
CameraOption = Annotated[
    str | None,
    typer.Option(
        "--camera",
        help='A camera that is known: a file (JSON of an earlier result, or YAML of OpenCV or ROS), or "pictures": '
        "the arm has no say in it.",
    ),
]
LaserOption = Annotated[
    str | None,
    typer.Option(
        "--laser",
        help="The laser's colour: red, green, blue, grey; none; or auto: the pictures tell, which is the default.",
    ),
]
DetailsOption = Annotated[
    bool, typer.Option("--details", help="With --from: every picture, value, check and note as well.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of this file, and those below `cell calibrate`."""
    group = typer.Typer(invoke_without_command=True)
    group.callback()(calibrate)
    stored.register(group)
    app.add_typer(group, name="calibrate")


def calibrate(
    context: typer.Context, config: ConfigOption = None, sim: options.SimOption = None, seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal, job: options.JobOption = "pot", source: SourceOption = None,
    board: BoardOption = None, plan: PlanOption = False, poses: PosesOption = None, pose_field: PoseFieldOption = None,
    setup: SetupOption = None, camera: CameraOption = None, laser: LaserOption = None, details: DetailsOption = False,
    json: JsonOption = False,
) -> None:  # fmt: skip
    """Calibrate rail, cameras, hand-eye and light plane, and store the result.

    Moves the cell through its own calibration poses over the boards on its deck; with --from it moves nothing.
    """
    if context.invoked_subcommand is not None:
        return
    given = {"--board": board, "--plan": plan, "--poses": poses, "--pose-field": pose_field, "--setup": setup}
    given |= {"--camera": camera, "--laser": laser, "--details": details}
    if source is None:
        for name in (name for name, value in given.items() if value):
            raise ConfigError(f"{name} belongs to --from; the boards on the deck are named in the configuration")
    else:
        said = _options(plan, poses, pose_field, setup, camera=camera, laser=laser)
        _from_folder(source, board, said, json, details)
        return
    from cell.apps.cli.progress import ProgressDisplay
    from cell.config.calibrations.store import archive_of, solve_observations
    from cell.measure.calibration.archive import read_archive
    from cell.procedures.calibrate.report import examine
    from cell.run.session.supervisor import Cell

    with (
        Cell.open(config, sim=sim, seed=seed, level=level.value, job=job) as cell,
        ProgressDisplay(compiles=True) as display,
    ):
        calibration = cell.calibrate(display, job)
        where, loaded = cell.calibrations_folder, cell.config
    # The devices are free again; what follows takes the observations as they were stored.
    observations = read_archive(archive_of(where, calibration))
    examination = examine(solve_observations(observations), observations, loaded, job)
    pictures = examination.draw(where / calibration.name)
    stored.print_solved(calibration.summary(), str(where), examination.summary, pictures, json)


def _options(
    plan: bool, poses: str | None, pose_field: str | None, setup: str | None, camera: str | None, laser: str | None
) -> Options:
    """What was said of a recording. Raises ConfigError for a word that is none of those allowed."""
    from cell.apps.recordings.command import Options
    from cell.apps.recordings.known_camera import read_camera
    from cell.measure.vision.stripe.planes import LaserChannel

    lasers = ("none", "red", "green", "blue", "grey", "auto")
    if setup not in (None, "eye-in-hand", "eye-to-hand"):
        raise ConfigError(f"--setup {setup}: allowed are eye-in-hand and eye-to-hand")
    if laser not in (None, *lasers):
        raise ConfigError(f"--laser {laser}: allowed are {', '.join(lasers)}")
    return Options(
        poses, pose_field, setup=None if setup is None else setup.replace("-", "_"), plan=plan,
        camera=None if camera in (None, "pictures") else read_camera(Path(str(camera))),
        hold_camera=camera == "pictures", laser=None if laser == "none" else LaserChannel(laser or "auto"),
    )  # fmt: skip


def _from_folder(folder: Path, board: str | None, said: Options, json: bool, details: bool) -> None:
    from cell.apps.cli.calibration.recorded_tables import print_recorded
    from cell.apps.recordings.command import calibrate_folder
    from cell.base.storage import sealed
    from cell.measure.vision.board.view import parse_board

    result = calibrate_folder(folder, None if board is None else parse_board(board, single_tag=True), said)
    if json:
        # Kept in a file, it may come back with --camera.
        print_json(sealed(result.as_dict()))
    else:
        print_recorded(result.as_dict(), details)
    if not any(frame["used"] for frame in result.frames):
        raise ConfigError(
            f"no picture in {folder} could be used: is {board} the board in the pictures? The reasons are listed above"
        )
    if result.refused:
        raise RefusedError("; ".join(result.refused.values()))
    if not said.plan and result.intrinsics is None and result.hand_eye is None:
        raise ConfigError(f"nothing could be calibrated from {folder}: {'; '.join(result.notes)}")

"""`cell calibrate`: the cell's own calibration, or one from a folder of recorded frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table

from cell.apps.cli import options
from cell.apps.cli.calibration import stored
from cell.apps.cli.options import ConfigOption, JsonOption, Level, new_table, print_json
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
Setup = Literal["eye-in-hand", "eye-to-hand"]
SetupOption = Annotated[
    Setup | None, typer.Option("--setup", help="Where the camera was: eye-in-hand or eye-to-hand; else the poses tell.")
]
CameraOption = Annotated[str | None, typer.Option(
    "--camera", help='A camera that is known: a file (JSON of an earlier result, or YAML of OpenCV or ROS), or '
    '"pictures": the arm has no say in it.',
)]  # fmt: skip
Laser = Literal["none", "red", "green", "blue", "grey", "auto"]
LaserOption = Annotated[Laser | None, typer.Option(
    "--laser", help="The laser's colour: red, green, blue, grey; none; or auto, the default: the pictures tell."
)]  # fmt: skip
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
    plan: bool, poses: str | None, pose_field: str | None, setup: Setup | None, camera: str | None, laser: Laser | None
) -> Options:
    """What was said of a recording."""
    from cell.apps.recordings.command import Options
    from cell.apps.recordings.known_camera import read_camera
    from cell.measure.vision.stripe.planes import LaserChannel

    return Options(
        poses, pose_field, setup=None if setup is None else setup.replace("-", "_"), plan=plan,
        camera=None if camera in (None, "pictures") else read_camera(Path(str(camera))),
        hold_camera=camera == "pictures", laser=None if laser == "none" else LaserChannel(laser or "auto"),
    )  # fmt: skip


def _from_folder(folder: Path, board: str | None, said: Options, json: bool, details: bool) -> None:
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


Result = Mapping[str, Any]
PARTS = {"intrinsics": "camera", "hand_eye": "hand-eye", "light_plane": "light plane"}


def print_recorded(result: Result, details: bool = False) -> None:
    """Which pictures were used, how poses were read, and one verdict for each part; with `details` all there is."""
    console = Console()

    def say(text: str) -> None:
        console.print(text, markup=False, soft_wrap=True, highlight=False)

    frames = result["frames"]
    say(f"{sum(f['used'] for f in frames)} of {len(frames)} used")
    for frame in frames:
        if not frame["used"]:
            say(f"{frame['name']} not used: {frame['text']}")
    _say_poses(say, result)
    if details:
        _print_details(console, say, result)
    for line in verdicts(result):
        say(line)
    if not details:
        say("More with --details.")


def _print_details(console: Console, say: Callable[[str], None], result: Result) -> None:
    """Every picture, value, check and note."""
    if result["board"] is not None:
        rows = [
            (f["name"], f["points"], f["pose_from"], f["stripe_from"] or ("here" if f["stripe"] else ""), f["rms_px"])
            for f in result["frames"]
        ]
        console.print(_table("recorded frames", ("picture", "points", "pose", "stripe", "RMS in px"), rows))
    for part, name in PARTS.items():
        found = result[part] or result["refused_values"].get(part)
        if found is not None:
            title = name if result[part] is not None else f"{name}, REFUSED"
            console.print(_table(title, ("quantity", "value"), _plain(found)))
    if result["flatness"] is not None:
        flat = result["flatness"]
        frames_flat = [(f["name"], f["rms_mm"]) for f in flat["per_frame"]]
        whole = [("all frames", flat["rms_mm"]), ("95 % within", flat["p95_mm"])]
        title = f"flatness of the board in the {flat['frame']}, end to end, mm"
        console.print(_table(title, ("points of", "RMS"), frames_flat + whole))
    checks = [
        (PARTS[c["part"]], c["name"], c["value"], c["doubt_from"], c["refused_from"], c["unit"], c["verdict"])
        for c in result["checks"]
    ]
    console.print(_table("checks", ("of", "what", "found", "doubtful from", "refused from", "unit", ""), checks))
    for note in result["notes"]:
        say(note)


def verdicts(result: Result) -> list[str]:
    """One line for each part: its value ± σ, used or refused, and the reason in one sentence."""
    lines = []
    for part, name in PARTS.items():
        refused = result["refused"].get(part)
        value = _values(part, result[part] or result["refused_values"].get(part))
        texts = [
            c["text"].split(": ", 1)[-1] for c in result["checks"] if c["part"] == part and c["verdict"] == "doubt"
        ]
        if part == "hand_eye":
            texts = [n.removeprefix("doubt: ") for n in result["notes"] if n.startswith("doubt: ")] + texts
        ran = sum(c["part"] == part for c in result["checks"])
        if refused:
            lines.append(f"{name}: REFUSED{f' (do not use: {value})' if value else ''}: {refused}")
        elif value:
            reason = f"doubtful: {texts[0]}" if texts else f"all {ran} checks are well"
            lines.append(f"{name}: {value}; used; {reason}" + (f" ({len(texts) - 1} more doubts)" if texts[1:] else ""))
        else:
            said = (f"no {name.replace(' ', '-')}", f"no {name}", f"no {part}")
            why = next((note for note in result["notes"] if any(word in note for word in said)), "not asked for")
            lines.append(f"{name}: none: {why}")
    return lines


def _values(part: str, found: Result | None) -> str:
    if found is None:
        return ""
    if part == "intrinsics":
        return ", ".join(f"{n} {found[n]:.2f} ± {found['sigma_px'][n]:.2f}" for n in ("fx", "fy", "cx", "cy")) + " px"
    if part == "hand_eye":
        pairs = zip("xyz", found["translation_mm"], found["sigma_mm"], strict=True)
        place = ", ".join(f"{axis} {value:.2f} ± {sigma:.2f}" for axis, value, sigma in pairs)
        return f"{found['setup'].replace('_', ' ')}, {place} mm, turn ± {max(found['sigma_deg']):.3f} deg"
    sigma = found["sigma_place_mm"]
    place = "" if sigma is None else f" ± {sigma:.3f}"
    return f"normal {', '.join(f'{v:.4f}' for v in found['normal'])}, distance {found['distance_mm']:.2f}{place} mm"


def _say_poses(say: Callable[[str], None], result: Result) -> None:
    poses = result["poses"]
    if poses is not None and poses.get("reading") is not None:
        chosen = "as given" if "poses" in poses["given"] else "chosen by the pictures"
        say(
            f"poses: {', '.join(poses['source'])}, {poses['text']} ({poses['reading']}, {chosen}), in {poses['unit']}; "
            f"matched by {poses['matched_by']}; {poses['setup'].replace('_', ' ')} (if they are base_from_flange)\n"
            f"evidence: {poses['evidence']}"
        )
    laser = result["laser"]
    if laser is not None and any(frame["stripe"] for frame in result["frames"]):
        say(f"laser: read in {laser['channel']}")
    for file in result["unread"]:
        say(f"not understood: {file['name']}: {file['reason']}")


def _plain(found: Result) -> list[tuple[str, object]]:
    """Numbers and lists of numbers of a part, without what is nested deeper."""
    rows: list[tuple[str, object]] = []
    for key, value in found.items():
        if isinstance(value, Mapping):
            rows += [(f"{key} {name}", v) for name, v in value.items() if isinstance(v, (int, float))]
        elif not isinstance(value, list) or all(isinstance(v, (int, float)) for v in value):
            rows.append((key, value))
    return rows


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> Table:
    table = new_table(title, *columns)
    for row in rows:
        table.add_row(*map(_shown, row))
    return table


def _shown(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(map(_shown, value))
    if isinstance(value, float):
        return f"{value:.5g}" if math.isfinite(value) else "not known"
    return "" if value is None else str(value)

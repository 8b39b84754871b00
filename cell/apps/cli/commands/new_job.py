"""`cell new-job`: from the mesh of a surface to a job for it, with a picture before anything moves."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.apps.cli.options import ConfigOption, JsonOption, print_json

if TYPE_CHECKING:
    from cell.apps.new_job.make import Made

UnitOption = Annotated[
    str | None, typer.Option(help="Of the mesh: mm, m or inch. Told by its size where that is clear.")
]
BoardPlaceOption = Annotated[
    str | None, typer.Option(help='Its pose in the place frame: "x mm, y mm, z mm; roll deg, pitch deg, yaw deg".')
]
PriorOption = Annotated[str | None, typer.Option(help="How exactly the board tells where the surface is, 1 sigma.")]


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command("new-job")(new_job)


def new_job(
    mesh: Annotated[str | None, typer.Option(help="STL, PLY, OBJ or STEP of what the part is placed onto.")] = None,
    unit: UnitOption = None,
    bodies: Annotated[str | None, typer.Option(help='Which bodies of the mesh: "all", or numbers such as 1,2.')] = None,
    up: Annotated[str | None, typer.Option(help="Axis of the mesh that points up: z, -z, x, -x, y or -y.")] = None,
    turn: Annotated[str | None, typer.Option(help='Turn about it, such as "90 deg", or auto.')] = None,
    flip: Annotated[str | None, typer.Option(help="yes: turn all triangles round, if they face down.")] = None,
    name: Annotated[str | None, typer.Option(help="Of the job and its files; else that of the mesh.")] = None,
    like: Annotated[str | None, typer.Option(help="A job at the same station: its way, photograph and speeds.")] = None,
    board: Annotated[str | None, typer.Option(help="The board beside the place.")] = None,
    board_place: BoardPlaceOption = None,
    place: Annotated[str | None, typer.Option(help="Pose of the surface's origin in the place frame.")] = None,
    prior: PriorOption = None,
    prior_angle: Annotated[str | None, typer.Option(help="And how it is turned, 1 sigma.")] = None,
    part_size: Annotated[str | None, typer.Option(help='The part in the claw: "70 mm, 36 mm, 20 mm".')] = None,
    grasp: Annotated[str | None, typer.Option(help="Pose of the part's origin in the flange's frame.")] = None,
    grasp_sigma: Annotated[str | None, typer.Option(help="How exactly it is held, 1 sigma.")] = None,
    grasp_sigma_angle: Annotated[str | None, typer.Option(help="And turned, 1 sigma.")] = None,
    part_place: Annotated[str | None, typer.Option(help="Pose of the part's origin on the surface, placed.")] = None,
    tolerance: Annotated[str | None, typer.Option(help="How exactly it has to be placed.")] = None,
    tolerance_angle: Annotated[str | None, typer.Option(help="And turned.")] = None,
    step: Annotated[str | None, typer.Option(help="How far apart the lines of the scan are.")] = None,
    folder: Annotated[Path, typer.Option(help="Where to write the job, its mesh and its picture.")] = Path(),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Over files of these names.")] = False,
    config: ConfigOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ask nothing: what is not given has its default.")] = False,
    json: JsonOption = False,
) -> None:
    """Make a job for a surface of your own: asks, proposes a scan, checks it, draws it. Nothing moves.

    Every question is an option, too. Writes NAME.toml, NAME.stl (what the sweeps see) and NAME.png.
    """
    from cell.apps.new_job.make import make_job
    from cell.apps.new_job.questions import Asker
    from cell.config.cell_config import find_config, load_config

    given = {
        "mesh": mesh, "unit": unit, "bodies": bodies, "up": up, "turn": turn, "flip": flip, "name": name, "like": like,
        "board": board, "board-place": board_place, "place": place, "prior": prior, "prior-angle": prior_angle,
        "part-size": part_size, "grasp": grasp, "grasp-sigma": grasp_sigma, "grasp-sigma-angle": grasp_sigma_angle,
        "part-place": part_place, "tolerance": tolerance, "tolerance-angle": tolerance_angle, "step": step,
    }  # fmt: skip
    told: list[str] = []

    def tell(text: str) -> None:
        told.append(text)
        if not json:
            typer.echo(text)

    source = find_config(config, simulated=True)
    made = make_job(
        Asker(given, None if yes else partial(typer.prompt, err=json), tell), load_config(source), folder, overwrite
    )
    if json:
        print_json(
            {"job": str(made.job), "mesh": str(made.mesh), "picture": str(made.picture), "seen": round(made.seen, 3),
             "expected": made.place.summary(), "told": told, "notes": list(made.notes)}
        )  # fmt: skip
    else:
        _print_made(made, "" if source is None or config is None else f" -c {config}")


def _print_made(made: Made, where: str) -> None:
    """What was made, for people, and the commands that come next, with the option `where`."""
    for note in made.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"surface: {100 * made.seen:.0f} % of it is seen; {made.place.verdict.worst.words}")
    for free in made.place.verdict.unseen:
        typer.echo(f"note: {free} is told by the board alone, not by the scan")
    typer.echo(f"wrote {made.job} and {made.mesh}")
    typer.echo(f"next: cell check{where} -j {made.job}, then cell dry-run{where} -j {made.job} --clock virtual")

"""`cell init`, `check`, `new-job`: what a cell and a job start from. `cell sim serve`, `fill`: a simulated cell."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.apps.cli import EXIT_USAGE, options
from cell.apps.cli.options import ConfigOption, JobOption, JsonOption, print_json
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from cell.apps.new_job.make import Made

UnitOption = Annotated[
    str | None, typer.Option(help="Of the mesh: mm, m or inch. Told by its size where that is clear.")
]
BoardPlaceOption = Annotated[
    str | None, typer.Option(help='Its pose in the place frame: "x mm, y mm, z mm; roll deg, pitch deg, yaw deg".')
]
PriorOption = Annotated[str | None, typer.Option(help="How exactly the board tells where the surface is, 1 sigma.")]


def init(
    folder: Annotated[Path, typer.Argument(help="Where to write cell.toml, the job and its mesh.")] = Path(),
    job: JobOption = "pot",
) -> None:
    """Write a complete configuration and a job to start from. Never overwrites a file."""
    import shutil

    from cell.config.cell_config import default_toml
    from cell.config.job import job_path, load_job

    source, (loaded, mesh) = job_path(job), load_job(job)
    meshes = [mesh] if loaded.part is None else [mesh, Path(loaded.part.mesh)]
    targets = {folder / "cell.toml": None, folder / source.name: source, **{folder / one.name: one for one in meshes}}
    if astray := [one for one in meshes if one.parent.resolve() != source.parent.resolve()]:
        raise ConfigError(f"{astray[0]} does not lie beside {source}: copy the job and its meshes by hand")
    if len(targets) < 2 + len(set(meshes)):
        raise ConfigError(f"{source.name} is what the configuration is called; give the job another name")
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder} is no folder; name another one")
    for target in targets:
        if target.exists():
            raise ConfigError(f"{target} exists already; move it away or name another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for target, origin in targets.items():
            if origin is None:
                target.write_text(default_toml(), encoding="utf-8")
            else:
                shutil.copyfile(origin, target)
            typer.echo(f"wrote {target}")
    except OSError as error:
        raise ConfigError(f"nothing can be written to {folder}: {error.strerror}; name another folder") from error


def check(config: ConfigOption = None, job: JobOption = "pot", json: JsonOption = False) -> None:
    """Read the configuration and the job and say what is wrong with them; touches no device."""
    from cell.apps.console.view.scene import link_meshes
    from cell.check.fit import read_fitting
    from cell.check.place import contact_notes
    from cell.config.cell_config import DEVICES, beside, example_addresses, find_config, load_config, require_confirm
    from cell.config.job import job_and_item, job_path
    from cell.devices.simulated.mixed import require_possible
    from cell.run.report.figures import simulated_words

    source = find_config(config, simulated=True)
    told: dict[str, object] = {"ok": False, "configuration": "the one that ships" if source is None else str(source)}
    try:
        loaded = load_config(source)
        require_confirm(loaded)
        told["job_file"] = str(job_path(job))
        checked, mesh = read_fitting(job, loaded)
        if loaded.cell.meshes:
            link_meshes(beside(source) / loaded.cell.meshes)
        if loaded.cell.sim:
            require_possible(loaded, loaded.cell.sim, DEVICES)
    except ConfigError as error:
        if json:
            print_json({**told, "problems": [line.strip() for line in str(error).splitlines()]})
            raise typer.Exit(EXIT_USAGE) from error
        raise
    examples = [key for key in example_addresses(loaded) if key.partition(".")[0] not in loaded.cell.sim]
    notes = [f"{key} is the example's, where no device is: write your own" for key in examples]
    notes += contact_notes(checked, mesh)
    records = {name: loaded.device(name) for name in DEVICES}
    notes += [f'{name}.driver = "{r.driver}": {r.CAUTION}' for name, r in records.items() if r.CAUTION]
    told |= {
        "ok": True, "cell": loaded.cell.name, "configuration_hash": loaded.calibration_hash(),
        "simulated": bool(loaded.cell.truth) or list(loaded.cell.sim), "confirm": loaded.cell.confirm,
        "job": job_and_item(checked.job.name)[0], "mesh": str(mesh), "problems": [], "notes": notes,
    }  # fmt: skip
    if json:
        print_json(told)
        return
    typer.echo(f"cell {loaded.cell.name}: configuration is valid ({told['configuration']})")
    typer.echo(f"job {told['job']}: valid and in reach ({told['job_file']}), mesh {mesh}")
    if words := simulated_words(list(loaded.cell.sim)):
        typer.echo(f"note: {words} (cell.sim)")
    for note in notes:
        typer.echo(f"note: {note}")


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
    part: Annotated[str | None, typer.Option(help="STL or PLY of the part itself, in its own frame.")] = None,
    part_unit: Annotated[str | None, typer.Option(help="Of the part's mesh: mm or m.")] = None,
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
        "part": part, "part-unit": part_unit, "part-size": part_size, "part-place": part_place, "grasp": grasp,
        "grasp-sigma": grasp_sigma, "grasp-sigma-angle": grasp_sigma_angle, "tolerance": tolerance,
        "tolerance-angle": tolerance_angle, "step": step,
    }  # fmt: skip
    told, source = list[str](), find_config(config, simulated=True)

    def notify(text: str) -> None:
        told.append(text)
        if not json:
            typer.echo(text)

    asker = Asker(given, None if yes else partial(typer.prompt, err=json), notify)
    asker.used |= {name: str(at) for name, at in (("config", config), ("folder", folder)) if at not in (None, Path())}
    made = make_job(asker, load_config(source), folder, overwrite)
    if json:
        known = {"seen": round(made.seen, 3), "expected": made.place.summary(), "notes": list(made.notes), "told": told}
        print_json({name: str(getattr(made, name)) for name in ("job", "mesh", "picture")} | known)
    else:
        _print_made(made, "" if source is None or config is None else f" -c {shlex.quote(str(config))}")


def _print_made(made: Made, where: str) -> None:
    """What was made, for people, and the commands that come next, with the option `where`."""
    for note in made.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"surface: {100 * made.seen:.0f} % of it is seen; {made.place.verdict.worst.words}")
    for free in made.place.verdict.unseen:
        typer.echo(f"note: {free} is told by the board alone, not by the scan")
    typer.echo(f"wrote {made.job} and {made.mesh}")
    job = shlex.quote(str(made.job))
    typer.echo(f"next: cell check{where} -j {job}, then cell dry-run{where} -j {job} --clock virtual")


# --- a simulated cell ---

sim = typer.Typer(help="The simulated cell.", no_args_is_help=True)


@sim.command()
def serve(
    seed: options.SeedOption = 1,
    level: options.LevelOption = options.Level.nominal,
    speed: options.SpeedOption = 1.0,
    config: ConfigOption = None,
    job: JobOption = "pot",
    gige: Annotated[
        list[str] | None, typer.Option(help="This camera on GigE Vision: scan or target; may be given twice.")
    ] = None,
    json: JsonOption = False,
    config_out: Annotated[
        Path | None, typer.Option(help="Also write a configuration that names the simulated endpoints.")
    ] = None,
) -> None:
    """Serve the cell that configuration and job describe until interrupted; prints its endpoints.

    `cell sim fill` sets up the station of another job on it, or fills the claw again.
    """
    import sys

    from cell.config.cell_config import config_to_open, tables_of
    from cell.devices.simulated.described import Described
    from sim_backends import serve as server

    path, loaded = config_to_open(config, simulated=True)
    drawing = Described.of(job).drawing(loaded)
    if config_out is not None and config_out.exists():
        raise ConfigError(f"{config_out} exists already; move it away or name another file")
    if config_out is not None and not config_out.parent.is_dir():
        raise ConfigError(f"--config-out: there is no folder {config_out.parent}; make it first")

    def ready(endpoints: dict[str, object]) -> None:
        if config_out is not None:
            from cell.devices.simulated.process import endpoint_toml

            config_out.write_text(endpoint_toml(tables_of(path), endpoints), encoding="utf-8")

    arguments = ["--seed", str(seed), "--level", level.value, "--speed", repr(speed), "--drawing", drawing.as_json()]
    arguments += [word for name in gige or () for word in ("--gige", name)]
    sys.exit(server.main([*arguments, *(["--json"] if json else [])], ready=ready))


@sim.command()
def fill(config: ConfigOption = None, job: JobOption = "pot") -> None:
    """At a served cell, as a person would: set up the job's station, and put its part into the claw.

    What lay there is taken away. Nothing changes where the station stands already, with its part in the claw.
    """
    from cell.config.cell_config import find_config, load_config
    from cell.devices.simulated.described import Described
    from cell.devices.simulated.process import make_ready

    loaded, described = load_config(find_config(config)), Described.of(job)
    if not loaded.cell.truth:
        raise ConfigError(
            "this configuration names no simulated cell (cell.truth is empty): at a real one a person fills the claw; "
            "name the file that `cell sim serve --config-out FILE` wrote with -c FILE"
        )
    make_ready(loaded.cell.truth, described.drawing(loaded).as_json())
    typer.echo(f"the station of job {described.job.job.name} is set up, its part is in the claw")

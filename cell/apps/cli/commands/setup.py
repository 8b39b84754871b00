"""`cell init` and `cell check`: a configuration and a job to start from, and what is wrong with one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cell.apps.cli import EXIT_USAGE
from cell.apps.cli.options import ConfigOption, JobOption, JsonOption, print_json


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(init)
    app.command()(check)


def init(
    folder: Annotated[Path, typer.Argument(help="Where to write cell.toml, the job and its mesh.")] = Path(),
    job: JobOption = "pot",
) -> None:
    """Write a complete configuration and a job to start from. Never overwrites a file."""
    import shutil

    from cell.config.cell_config import default_toml
    from cell.config.job import job_path, load_job
    from drivers.errors import ConfigError

    _, mesh = load_job(job)
    source = job_path(job)
    targets = {folder / "cell.toml": None, folder / source.name: source, folder / mesh.name: mesh}
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
    from cell.check.fit import require_fit
    from cell.check.place import contact_notes
    from cell.config.cell_config import DEVICES, beside, example_addresses, find_config, load_config, require_confirm
    from cell.config.job import job_path, load_job
    from cell.devices.simulated.mixed import require_possible
    from cell.run.report.figures import simulated_words
    from drivers.errors import ConfigError

    source = find_config(config, simulated=True)
    told: dict[str, object] = {"ok": False, "configuration": "the one that ships" if source is None else str(source)}
    try:
        loaded = load_config(source)
        require_confirm(loaded)
        checked, mesh = load_job(job)
        told["job_file"] = str(job_path(job))
        require_fit(checked, loaded, mesh)
        if loaded.cell.meshes:
            link_meshes(beside(source) / loaded.cell.meshes)
    except ConfigError as error:
        if json:
            print_json({**told, "problems": [line.strip() for line in str(error).splitlines()]})
            raise typer.Exit(EXIT_USAGE) from error
        raise
    if loaded.cell.sim:
        require_possible(loaded, loaded.cell.sim, DEVICES)
    examples = [key for key in example_addresses(loaded) if key.partition(".")[0] not in loaded.cell.sim]
    notes = [f"{key} is the example's, where no device is: write your own" for key in examples]
    notes += contact_notes(checked, mesh)
    records = {name: loaded.device(name) for name in DEVICES}
    notes += [f'{name}.driver = "{r.driver}": {r.CAUTION}' for name, r in records.items() if r.CAUTION]
    told |= {
        "ok": True,
        "cell": loaded.cell.name,
        "configuration_hash": loaded.calibration_hash(),
        "simulated": bool(loaded.cell.truth) or list(loaded.cell.sim),
        "confirm": loaded.cell.confirm,
        "job": checked.job.name,
        "mesh": str(mesh),
        "problems": [],
        "notes": notes,
    }
    if json:
        print_json(told)
        return
    typer.echo(f"cell {loaded.cell.name}: configuration is valid ({told['configuration']})")
    typer.echo(f"job {checked.job.name}: valid and in reach ({told['job_file']}), mesh {mesh}")
    if words := simulated_words(list(loaded.cell.sim)):
        typer.echo(f"note: {words} (cell.sim)")
    for note in notes:
        typer.echo(f"note: {note}")

"""`cell init` and `cell check`: a configuration and a job to start from, and what is wrong with one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cell.cli.options import ConfigOption, JobOption, JsonOption, print_json


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

    from cell.config import default_toml
    from cell.job import job_path, load_job
    from drivers.errors import ConfigError

    _, mesh = load_job(job)
    source = job_path(job)
    targets = {folder / "cell.toml": None, folder / source.name: source, folder / mesh.name: mesh}
    for target in targets:
        if target.exists():
            raise ConfigError(f"{target} exists already; move it away or name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for target, origin in targets.items():
        if origin is None:
            target.write_text(default_toml(), encoding="utf-8")
        else:
            shutil.copyfile(origin, target)
        typer.echo(f"wrote {target}")


def check(config: ConfigOption = None, job: JobOption = "pot", json: JsonOption = False) -> None:
    """Read the configuration and the job and say what is wrong with them; touches no device."""
    from cell.config import load_config
    from cell.job import load_job, require_fit

    loaded = load_config(config)
    checked, mesh = load_job(job)
    require_fit(checked, loaded)
    if json:
        print_json({"cell": loaded.cell.name, "job": checked.job.name, "mesh": str(mesh), "ok": True})
    else:
        typer.echo(f"cell {loaded.cell.name}: configuration is valid")
        typer.echo(f"job {checked.job.name}: valid, mesh {mesh}")

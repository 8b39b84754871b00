"""`cell sim serve`: a simulated cell that any client of these protocols can use."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cell.apps.cli.options import ConfigOption, JobOption, JsonOption, Level, LevelOption, SeedOption, SpeedOption

app = typer.Typer(help="The simulated cell.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """The simulated cell."""


@app.command()
def serve(
    seed: SeedOption = 1,
    level: LevelOption = Level.nominal,
    speed: SpeedOption = 1.0,
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
    from drivers.errors import ConfigError
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


@app.command()
def fill(config: ConfigOption = None, job: JobOption = "pot") -> None:
    """At a served cell, as a person would: set up the job's station, and put its part into the claw.

    What lay there is taken away. Nothing changes where the station stands already, with its part in the claw.
    """
    from cell.config.cell_config import find_config, load_config
    from cell.devices.simulated.described import Described
    from cell.devices.simulated.process import make_ready
    from drivers.errors import ConfigError

    loaded, described = load_config(find_config(config)), Described.of(job)
    if not loaded.cell.truth:
        raise ConfigError(
            "this configuration names no simulated cell (cell.truth is empty): at a real one a person fills the claw; "
            "name the file that `cell sim serve --config-out FILE` wrote with -c FILE"
        )
    make_ready(loaded.cell.truth, described.drawing(loaded).as_json())
    typer.echo(f"the station of job {described.job.job.name} is set up, its part is in the claw")

"""`cell sim serve`: a simulated cell that any client of these protocols can use."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cell.cli.options import JsonOption, Level, LevelOption, SeedOption, SpeedOption

app = typer.Typer(help="The simulated cell.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """The simulated cell."""


@app.command()
def serve(
    seed: SeedOption = 1,
    level: LevelOption = Level.nominal,
    speed: SpeedOption = 1.0,
    surface: Annotated[str, typer.Option(help="What stands on the place: pot, seat or panel.")] = "pot",
    arm: Annotated[str, typer.Option(help="Which arm, by the maker's name.")] = "UR10e",
    gige: Annotated[
        list[str] | None, typer.Option(help="This camera on GigE Vision: scan or target; may be given twice.")
    ] = None,
    json: JsonOption = False,
    config_out: Annotated[
        Path | None, typer.Option(help="Also write a configuration that names the simulated endpoints.")
    ] = None,
) -> None:
    """Serve a simulated cell until interrupted; prints its endpoints."""
    import sys

    from drivers.errors import ConfigError
    from sim_backends import serve as server
    from sim_backends.world.surfaces import SURFACES

    if surface not in SURFACES:
        raise ConfigError(f'--surface "{surface}" is none of {", ".join(sorted(SURFACES))}')

    if config_out is not None and config_out.exists():
        raise ConfigError(f"{config_out} exists already; move it away or name another file")
    if config_out is not None and not config_out.parent.is_dir():
        raise ConfigError(f"--config-out: there is no folder {config_out.parent}; make it first")

    def ready(endpoints: dict[str, object]) -> None:
        if config_out is not None:
            from cell.devices.simulated import endpoint_toml

            config_out.write_text(endpoint_toml(endpoints), encoding="utf-8")

    arguments = ["--seed", str(seed), "--level", level.value, "--speed", repr(speed), "--surface", surface]
    arguments += ["--arm", arm, *(word for name in gige or () for word in ("--gige", name))]
    sys.exit(server.main([*arguments, *(["--json"] if json else [])], ready=ready))

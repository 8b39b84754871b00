"""What the shell offers at tab: runs, jobs, devices, faults and effects, by their names.

Asked for at each tab, so nothing heavy is loaded where a file's name tells it, and whatever is wrong offers nothing.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import typer

MOST_RUNS = 50


def runs(ctx: typer.Context, incomplete: str) -> list[str]:
    """Ids of the newest runs beside the configuration that is named, else of the present folder."""
    try:
        config = Path(ctx.params.get("config") or "cell.toml")
        told = tomllib.loads(config.read_text(encoding="utf-8")) if config.is_file() else {}
        folder = config.parent / str(told.get("cell", {}).get("runs", "runs"))
        names = sorted((entry.name for entry in folder.iterdir() if (entry / "journal.sqlite").exists()), reverse=True)
    except (OSError, ValueError, AttributeError):
        return []
    ids = [name.rpartition("-")[2] for name in names[:MOST_RUNS]]
    return [name for name in (*ids, *(names if incomplete.startswith("2") else ())) if name.startswith(incomplete)]


def jobs(incomplete: str) -> list[str]:
    """Jobs that ship, and those of the present folder."""
    from importlib.resources import files

    shipped = {entry.name for entry in files("cell").joinpath("jobs").iterdir()}
    own = {path.name for path in Path().glob("*.toml") if _is_job(path)}
    names = {name.removesuffix(".toml") for name in shipped | own if name.endswith(".toml")}
    return sorted(name for name in names if name.startswith(incomplete))


def _is_job(path: Path) -> bool:
    try:
        return "job" in tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False


def devices(incomplete: str) -> list[str]:
    """Devices of a cell."""
    from cell.config.files import DEVICES

    return [name for name in DEVICES if name.startswith(incomplete)]


def jogged(incomplete: str) -> list[str]:
    """Devices that are jogged."""
    return [name for name in ("rail", "arm", "vehicle") if name.startswith(incomplete)]


def homed(incomplete: str) -> list[str]:
    """Devices that have a home."""
    return [name for name in ("rail", "arm") if name.startswith(incomplete)]


def faults(incomplete: str) -> list[str]:
    """Faults of a simulated cell; the step and how far it is then, as in `@laser_sweep:40%`, are for the person."""
    from sim_backends.faults import FAULT_NAMES

    return [name for name in FAULT_NAMES if name.startswith(incomplete)]


def steps(incomplete: str) -> list[str]:
    """Steps of the jobs that ship."""
    from cell.procedures.steps.kinds import PLACE

    return [name for name in PLACE.names if name.startswith(incomplete)]


def effects(incomplete: str) -> list[str]:
    """Effects of a workshop in a simulated world."""
    from sim_backends.world.effects import Effects

    return [name for name in Effects.names() if name.startswith(incomplete)]

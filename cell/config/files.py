"""Which configuration counts here and where its runs lie, for commands that must be quick: nothing heavy is loaded.

What a configuration holds is read and checked in `cell.config`.
"""

import tomllib
from contextlib import suppress
from pathlib import Path

from drivers.errors import ConfigError

CONFIGURATION = "cell.toml"
RUNS = "runs"
"""The folder of runs unless `cell.runs` names another."""

DEVICES = {
    "arm": "arm", "rail": "rail", "vehicle": "vehicle", "scan_camera": "camera", "target_camera": "camera",
    "laser": "laser", "claw": "claw",
}  # fmt: skip
"""The cell's devices by the name of their table, and what kind each is."""


def find_config(path: Path | None, *, simulated: bool = False) -> Path | None:
    """The configuration's file: the one that is given, else `cell.toml` of the present folder.

    Where there is neither, None (the configuration that ships) if `simulated`, that is, if no real device will be
    asked for anything; else `NoConfiguration`: nothing moves at an address that nobody gave.
    """
    if path is not None:
        return path
    here = Path(CONFIGURATION)
    if here.exists() or here.is_symlink():
        return here
    if simulated:
        return None
    raise NoConfiguration(
        f"there is no {CONFIGURATION} in {Path.cwd()}, and nothing is done at an address that nobody gave: name your "
        "configuration with -c FILE, or let `cell init` write one and put your addresses into it. `cell dry-run`, or "
        "the same command with --sim all, simulates a cell"
    )


class NoConfiguration(ConfigError):
    """A command for real devices was given no configuration, and the present folder has none."""


def beside(path: Path | None) -> Path:
    """The folder of a configuration, where runs and calibrations go; without a file, the present folder."""
    return Path.cwd() if path is None else path.resolve().parent


def runs_folder(path: Path | None) -> Path:
    """Where a configuration says that runs go, however wrong the rest of it is: what goes on is ended all the same."""
    runs = RUNS
    with suppress(OSError, ValueError, RecursionError, AttributeError):
        named = {} if path is None else tomllib.loads(path.read_text(encoding="utf-8")).get("cell", {})
        if isinstance(told := named.get("runs"), str) and told != RUNS:
            from drivers.common.addresses import checked_folder

            runs = checked_folder(told)
    return beside(path) / runs

"""`cell calibrate list`, `show` and `accept`: the stored calibrations, what was found out since, and edits of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cell.apps.cli.options import ConfigOption, JsonOption, new_table, print_json


def register(group: typer.Typer) -> None:
    """Add the commands of this file to `cell calibrate`."""
    group.command(name="list")(list_calibrations)
    group.command()(show)
    group.command()(accept)


def list_calibrations(config: ConfigOption = None, json: JsonOption = False) -> None:
    """List the stored calibrations, newest last: when, of which devices, how well they fit, what was found since."""
    from rich.console import Console

    from cell.config.calibrations.store import read_calibration
    from drivers.errors import CalibrationStale

    rows: list[dict[str, Any]] = []
    for path in sorted(_folder(config).glob("*.json")):
        try:
            calibration = read_calibration(path)
        except CalibrationStale as error:
            rows.append({"name": path.stem, "made": 0.0, "unreadable": str(error)})
            continue
        told = calibration.summary()
        kept = {name: told[name] for name in ("date", "identities", "laser_since", "timing")}
        fit = {"chi2_per_dof": told["scan_quality"]["chi2_per_dof"]}
        rows.append({"name": path.stem, "made": calibration.made, "hash": calibration.hash(), **kept, **fit})
    rows.sort(key=lambda row: float(row["made"]))
    if json:
        print_json(rows)
        return
    columns = ("made", "name", "hash", "chi²/dof", "found since")
    table = new_table(f"calibrations in {_folder(config)}", *columns)
    for row in rows:
        if "unreadable" in row:
            table.add_row("", row["name"], "", "", row["unreadable"])
            continue
        table.add_row(row["date"], row["name"], row["hash"], f"{row['chi2_per_dof']:.3f}", _since(row))
    Console().print(table)


def show(
    name: Annotated[
        str | None, typer.Argument(help="As `cell calibrate list` names it; without it the newest.")
    ] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Show a stored calibration: its values with their deviations, and what was found out since."""
    from cell.apps.cli.display import print_calibration
    from cell.config.calibrations.store import read_calibration
    from drivers.errors import CalibrationStale, ConfigError

    folder = _folder(config)
    paths = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime)
    chosen = [path for path in paths if name in (None, path.stem)]
    if not chosen:
        known = ", ".join(path.stem for path in paths) or "none"
        raise ConfigError(f"{folder} holds no calibration {name or ''}; there are: {known}; see `cell calibrate list`")
    try:
        summary = read_calibration(chosen[-1]).summary()
    except CalibrationStale as error:
        raise ConfigError(str(error)) from error
    if json:
        print_json(summary)
    else:
        print_calibration(summary, str(chosen[-1]))


def accept(
    name: Annotated[str, typer.Argument(help="As `cell calibrate list` names it.")],
    why: Annotated[str, typer.Option("--why", help="The reason for the edit; it is kept in the file.")],
    by: Annotated[str | None, typer.Option(help="Who accepts it; without it the user of this shell.")] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Accept a stored calibration that was edited by hand: who, when, why and which parts are kept in its file.

    Without it an edited calibration is refused. Every run with it names the edit in its report.
    """
    import getpass

    from cell.config.calibrations.store import accept_calibration
    from drivers.errors import ConfigError

    path = _folder(config) / f"{name}.json"
    if not why.strip():
        raise ConfigError("--why is empty; say in a few words what was edited, and for what reason")
    if not path.is_file():
        raise ConfigError(f"there is no calibration {path}; `cell calibrate list` names those that there are")
    edit = accept_calibration(path, by or getpass.getuser(), why).edits[-1]
    if json:
        print_json({"file": str(path), **edit})
    else:
        typer.echo(f"{path} is accepted as it is by {edit['who']}: {', '.join(edit['changed'])}")


def _since(row: dict[str, Any]) -> str:
    told = []
    if (turn := row["laser_since"]) is not None:
        told.append(f"laser turned {turn['turned_mrad']:+.3f} ± {turn['sigma_mrad']:.3f} mrad, verified {turn['date']}")
    if (timing := row["timing"]) is not None:
        told.append(
            f"time stamps {timing['late_ms']:+.2f} ± {timing['sigma_ms']:.2f} ms late, measured {timing['date']}"
        )
    return "; ".join(told)


def _folder(config: Path | None) -> Path:
    from cell.config.cell_config import beside, find_config, load_config

    path = find_config(config, simulated=True)
    return beside(path) / load_config(path).cell.calibrations

"""`cell calibrate list`, `show`, `accept`, `solve`, `verify` and `timing`: what is stored, and how good it is today."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.apps.cli import options
from cell.apps.cli.options import ConfigOption, JsonOption, Level, new_table, print_json
from drivers.errors import CalibrationStale, ConfigError

if TYPE_CHECKING:
    from rich.console import Console

Summary = Mapping[str, Any]


def register(group: typer.Typer) -> None:
    """Add the commands of this file to `cell calibrate`."""
    for name, command in (("solve", solve), ("verify", verify), ("timing", timing), ("list", list_calibrations),
                          ("show", show), ("accept", accept)):  # fmt: skip
        group.command(name)(command)


def solve(
    archive: Annotated[Path, typer.Argument(help="The .observations.npz beside a stored calibration.")],
    config: ConfigOption = None,
    job: options.JobOption = "pot",
    json: JsonOption = False,
) -> None:
    """Solve archived observations again, and examine the result; nothing moves and nothing stored is changed.

    Without --config the cameras as drawn and the assumed noise are those of the archive, and the result is the same as
    when it was made.
    """
    from dataclasses import replace

    from cell.config.calibrations.store import gathered, solve_observations
    from cell.config.cell_config import find_config, load_config
    from cell.measure.calibration.archive import SUFFIX, read_archive
    from cell.procedures.calibrate.report import examine

    observations = read_archive(archive)
    loaded = load_config(find_config(config, simulated=True))
    if config is not None:
        o = observations
        again = gathered(o.scan, o.target, o.identities, config=loaded, kinematics=o.kinematics, witness=o.witness)
        observations = replace(again, made=o.made)
    solved = solve_observations(observations)
    examination = examine(solved, observations, loaded, job)
    pictures = examination.draw(archive.with_name(archive.name.removesuffix(SUFFIX)))
    print_solved(solved.calibration.summary(), None, examination.summary, pictures, json)


def print_solved(summary: Summary, where: str | None, figures: Summary, pictures: Sequence[Path], json: bool) -> None:
    """A calibration, stored in `where` if at all, with its coverage, the parameters' influence, advice and pictures."""
    from rich.console import Console

    from cell.apps.cli.display import print_calibration

    if json:
        print_json({**summary, **figures, "pictures": [str(path) for path in pictures]})
        return
    print_calibration(summary, where)
    console = Console()
    _coverage(console, figures)
    influence = figures["influence"]
    title = f"place error left by the calibration: {influence['total_mm']:.4f} mm RMS at the job's points"
    columns = ("of", ">sigma", "unit", ">alone mm", ">total if known mm")
    table = new_table(title, *columns)
    for row in influence["groups"]:
        table.add_row(f"[bold]{row['name']}[/]", "", "", f"{row['alone_mm']:.4f}", f"{row['if_known_mm']:.4f}")
    table.add_section()
    for row in influence["parameters"]:
        table.add_row(
            row["name"], f"{row['sigma']:.3g}", row["unit"], f"{row['alone_mm']:.4f}", f"{row['if_known_mm']:.4f}"
        )
    console.print(table)
    console.print("Parameters are known together better than apart: what they do alone does not add up to the total.")
    table = new_table("what to add, by the predicted covariance", "what", "kind", ">then mm", ">less")
    for row in figures["advice"]:
        table.add_row(row["what"], row["kind"], f"{row['then_mm']:.4f}", f"{100 * row['gain']:.1f} %")
    console.print(table)
    for check in figures["checks"]:
        if check["text"]:
            console.print(f"doubtful ({check['camera']} camera): {check['text']}", markup=False, soft_wrap=True)
    for path in pictures:
        console.print(f"picture: {path}", markup=False, soft_wrap=True)


def _coverage(console: Console, figures: Summary) -> None:
    names = (">field", ">depth mm", ">tilt x deg", ">tilt y deg", ">rail mm", ">stripe depth mm", ">worst cell px")
    table = new_table("what the views cover", "camera", *names)
    for camera in ("scan", "target"):
        c = figures[f"{camera}_coverage"]
        ranges = ("depth_mm", "tilt_about_x_deg", "tilt_about_y_deg", "rail_mm", "stripe_depth_mm")
        shown = ["" if c[key] is None else f"{c[key][0]:.0f} to {c[key][1]:.0f}" for key in ranges]
        worst = "" if c["largest_cell_mean_px"] is None else f"{c['largest_cell_mean_px']:.3f}"
        table.add_row(camera, f"{100 * c['field_covered']:.0f} %", *shown, worst)
    console.print(table)


def verify(
    config: ConfigOption = None, sim: options.SimOption = None, seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal, job: options.JobOption = "pot", json: JsonOption = False,
) -> None:  # fmt: skip
    """Say how good the stored calibration is today, from a view of each deck board and a sweep over the fine one.

    Exit code 0: good, or changed by less than matters at the job's place. 1: the place may be off by a third of its
    tolerance or more, with the suspected part, or the pictures fit worse than they did.
    """
    from cell.apps.cli.progress import ProgressDisplay
    from cell.run.session.supervisor import Cell

    with Cell.open(config, sim=sim, seed=seed, level=level.value, job=job) as cell, ProgressDisplay() as display:
        verification = cell.verify(display, job)
    notify = print_json if json else print_verification
    notify(verification.summary())
    if not verification.good:
        raise typer.Exit(1)


def print_verification(summary: Summary) -> None:
    """The comparison for people: each figure with what a good calibration scatters by, then the decision."""
    from rich.console import Console

    console = Console()
    title = f"observed today against the calibration of {summary['calibration_date']}"
    table = new_table(title, "quantity", ">difference", ">sigma if good", "unit")
    for row in summary["figures"]:
        table.add_row(row["name"], f"{row['value']:+.4f}", f"{row['sigma']:.4f}", row["unit"])
    for kind, value in summary["residuals_over_calibration"].items():
        table.add_row(
            f"{kind}: residual over the calibration's", f"{value:.2f}", "1", f"≤ {summary['residuals_allowed']}"
        )
    console.print(table)
    title = f"changes that show in {summary['detectable_share']:.0%} of checks like this one"
    columns = ("part", "change", ">from", ">wanted", "unit")
    seen = new_table(title, *columns)
    for row in summary["detectable"]:
        size = "none" if row["size"] is None else f"{row['size']:.3f}"
        enough = row["size"] is not None and row["size"] <= row["wanted"]
        seen.add_row(
            row["part"], row["change"], size, f"{row['wanted']:g}", row["unit"], style=None if enough else "yellow"
        )
    console.print(seen)
    if summary["suspects"]:
        allowed = summary["place"]["allowed_mm"]
        off = (">probability", ">place off by, mm", ">at most", f">of {allowed:g} mm allowed")
        suspects = new_table("suspected parts", "part", *off, "most probable change")
        for row in summary["suspects"]:
            change = ", ".join(f"{name} {value:+.3f}" for name, value in row["change"].items())
            most = row["place_error_at_most_mm"]
            error = f"{row['place_error_mm']:.3f}", f"{most:.3f}", f"{most / allowed:.0%}"
            suspects.add_row(row["part"], f"{row['probability']:.0%}", *error, change)
        console.print(suspects)
    console.print(summary["reason"], style="green" if summary["good"] else "red", markup=False, soft_wrap=True)


def timing(
    config: ConfigOption = None, sim: options.SimOption = None, seed: options.SeedOption = 1,
    level: options.LevelOption = Level.nominal, job: options.JobOption = "pot", json: JsonOption = False,
) -> None:  # fmt: skip
    """Sweep to and fro over the fine board on the deck and measure how late the scan camera's time stamps come.

    What is found is kept with the stored calibration and taken out of every sweep by the rail. A rolling shutter, and
    stamps that are not those of an exposure's beginning, are refused by name. Exit code 1 when it is refused.
    """
    from cell.apps.cli.progress import ProgressDisplay
    from cell.run.session.supervisor import Cell

    with Cell.open(config, sim=sim, seed=seed, level=level.value) as cell, ProgressDisplay() as display:
        found = cell.time_stamps(display, job).scan.timing
    assert found is not None
    told = found.summary()
    if json:
        print_json(told)
        return
    typer.echo(
        f"the scan camera's time stamps come {told['late_ms']:+.2f} ± {told['sigma_ms']:.2f} ms late; the carriage's "
        f"play is {told['play_um']:.0f} ± {told['play_sigma_um']:.0f} µm; rows are exposed "
        f"{told['readout_ms']:.2f} ± {told['readout_sigma_ms']:.2f} ms one after the other. Kept with the calibration"
    )


def list_calibrations(config: ConfigOption = None, json: JsonOption = False) -> None:
    """List the stored calibrations, newest last: when, of which devices, how well they fit, what was found since."""
    from rich.console import Console

    from cell.config.calibrations.store import read_calibration

    rows: list[Summary] = []
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

    folder = _folder(config)

    def made(path: Path) -> float:
        # What is looked for later changes the file, not when the calibration was made.
        with suppress(CalibrationStale):
            return read_calibration(path).made
        return 0.0

    paths = sorted(folder.glob("*.json"), key=made)
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


def _since(row: Summary) -> str:
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

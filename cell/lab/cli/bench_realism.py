"""`cell bench realism`: each effect of the workshop alone and all together, beside what was stated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from cell.cli import completing
from cell.cli.options import JobOption, JsonOption, print_json

SHOWN = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "s": (1e3, "ms"), "rad/K": (1e6, "µrad/K")}


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(realism)


def realism(
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="Just this one; may be repeated. All of them, then together.",
            autocompletion=completing.effects,
        ),
    ] = None,
    seeds: Annotated[int, typer.Option("--seeds", min=1, max=1000, help="How many worlds: seeds 1 to this.")] = 20,
    job: JobOption = "pot",
    workers: Annotated[int, typer.Option("--workers", min=0, max=64, help="Processes; 0 is one a core.")] = 0,
    picture: Annotated[Path | None, typer.Option("--picture", help="Draw every effect to this PNG file.")] = None,
    json: JsonOption = False,
) -> None:
    """Put each effect of a workshop into simulated cells and see whether what is stated of the part still holds.

    An effect is well when its count of worlds inside the stated 95 % ellipsoid, or refused by the effect's name, is one
    that a true share of 90 % explains: 15 of 20 (95 % confidence). Exit code 1 when one is not, or a part was placed
    outside the job's tolerance.
    """
    from rich.console import Console

    from cell.lab.bench.realism import ALONE, TOGETHER, campaign, is_well
    from cell.lab.bench.realism_picture import draw
    from drivers.errors import ConfigError
    from sim_backends.world.effects import Effects

    known = (ALONE, *Effects.names(), TOGETHER)
    # No parts of the workshop: a scan camera needs a global shutter, a carriage that droops is a broken one.
    options = ("rolling_shutter", "droop")
    chosen = list(dict.fromkeys(effect or [name for name in known if name not in options]))
    if unknown := [name for name in chosen if name not in known]:
        raise ConfigError(f"--effect {unknown[0]} is none of {', '.join(known)}")
    if picture is not None and picture.suffix != ".png":
        raise ConfigError(f"--picture {picture} must end in .png")
    console = Console(stderr=True)
    result = campaign(
        chosen, range(1, seeds + 1), job, lambda text: console.print(text, markup=False, highlight=False), workers
    )
    if picture is not None:
        draw(picture, result)
    if json:
        print_json(result)
    else:
        _table(Console(), result)
    if not all(is_well(entry) for entry in result["effects"].values()):
        raise typer.Exit(1)


def _table(console: Any, result: Mapping[str, Any]) -> None:
    from rich.table import Table

    from cell.lab.bench.coverage import words

    table = Table(title=f"the workshop's effects, job {result['job']}, {len(result['seeds'])} worlds each (simulated)")
    table.add_column("effect")
    for name in ("size", "in", "named", "refused", "out", "true share %", "pose %", "part %", "placed mm"):
        table.add_column(name, justify="right")
    for name, entry in result["effects"].items():
        table.add_row(
            name,
            _size(entry["size"]),
            *(str(entry[key]) for key in ("inside", "named", "refused", "outside")),
            "{:.0f} to {:.0f}".format(*(100 * share for share in entry["between"])),
            *("" if entry[key] is None else f"{100 * entry[key]:.0f}" for key in ("pose_inside", "part_inside")),
            *("" if entry[key] is None else f"{entry[key]:.3f}" for key in ("placement_mm",)),
        )
    console.print(table)
    for name, entry in result["effects"].items():
        for text in (*entry["reasons"], *entry["flags"]):
            console.print(f"{name}: {text}", markup=False, soft_wrap=True)
    console.print(
        f"All that was placed: {words(result['placed']['inside'], result['placed']['worlds'])} inside what was stated "
        "(the effects share their seeds).",
        soft_wrap=True,
    )
    console.print(
        "in: pose and part within the stated 95 % ellipsoids; named: refused by the effect's name. The "
        "part is judged in the surface's plane: contact decides over the rest.",
        soft_wrap=True,
    )


def _size(size: Mapping[str, Any] | None) -> str:
    if size is None:
        return ""
    factor, unit = SHOWN.get(size["unit"], (1.0, size["unit"]))
    return f"{factor * size['sigma']:.3g} {unit}"

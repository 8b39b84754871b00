"""`cell bench realism`: each effect of the workshop alone and all together, beside what was stated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from cell.apps.cli import options as completing
from cell.apps.cli.options import JobOption, JsonOption
from lab.cli.shown import bar, counted, show, table

SHOWN = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "s": (1e3, "ms"), "rad/K": (1e6, "µrad/K")}


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
    json: JsonOption = False,
) -> None:
    """Put each effect of a workshop into simulated cells and see whether what is stated of the part still holds.

    An effect is well when its count of worlds inside the stated 95 % ellipsoid, or refused by the effect's name, is one
    that a true share of 90 % explains: 15 of 20 (95 % confidence). Exit code 1 when one is not, or a part was placed
    outside the job's tolerance.
    """
    from drivers.errors import ConfigError
    from lab.bench.job.realism import ALONE, TOGETHER, campaign, is_well
    from sim_backends.world.levels import Effects

    known = (ALONE, *Effects.names(), TOGETHER)
    # No parts of the workshop: a scan camera needs a global shutter, a carriage that droops is a broken one.
    options = ("rolling_shutter", "droop")
    chosen = list(dict.fromkeys(effect or [name for name in known if name not in options]))
    if unknown := [name for name in chosen if name not in known]:
        raise ConfigError(f"--effect {unknown[0]} is none of {', '.join(known)}")
    with bar() as told:
        result = campaign(chosen, range(1, seeds + 1), job, counted(told, len(chosen) * seeds), workers)
    show(result, json, _print)
    if not all(is_well(entry) for entry in result["effects"].values()):
        raise typer.Exit(1)


def _print(result: Mapping[str, Any]) -> None:
    from rich.console import Console

    from lab.bench.coverage import words

    rows = []
    for name, entry in result["effects"].items():
        shares = [None if entry[key] is None else f"{100 * entry[key]:.0f}" for key in ("pose_inside", "part_inside")]
        placed = None if entry["placement_mm"] is None else f"{entry['placement_mm']:.3f}"
        low, high = entry["between"]
        counts = [entry[key] for key in ("inside", "named", "refused", "outside")]
        rows.append((name, _size(entry["size"]), *counts, f"{100 * low:.0f} to {100 * high:.0f}", *shares, placed))
    title = f"the workshop's effects, job {result['job']}, {len(result['seeds'])} worlds each (simulated)"
    columns = ("effect", "size", "in", "named", "refused", "out", "true share %", "pose %", "part %", "placed mm")
    console = Console()
    console.print(table(title, columns, rows))
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

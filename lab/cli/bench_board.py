"""`cell bench board`: the board detection under light, blur, hidden parts and wrong boards, as a table."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.apps.cli.options import JsonOption, wide_console
from lab.cli.shown import bar, counted, formed, show


def board(
    views: Annotated[int, typer.Option(min=1, max=10_000, help="Random views for each kind of board and line.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Which random views.")] = 1,
    kind: Annotated[list[str] | None, typer.Option(help="Only this kind of board; may be given again.")] = None,
    condition: Annotated[
        list[str] | None, typer.Option(help="Only conditions with this in their name; may be given again.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """How surely boards are found, under which name their points, how exactly, and whether the covariance is true.

    Exit code 1 when a board, or the order of its points, was taken for another.
    """
    from cell.measure.vision.board.view import KINDS
    from drivers.errors import ConfigError
    from lab.bench.board.campaign import campaign
    from lab.bench.board.conditions import CONDITIONS

    kinds = [k for k in KINDS if not kind or k in kind]
    if kind and len(kinds) != len(set(kind)):
        raise ConfigError(f"--kind {', '.join(kind)}: allowed are {', '.join(KINDS)}")
    chosen = [c for c in CONDITIONS if not condition or any(text in c.name for text in condition)]
    if not chosen:
        raise ConfigError(f"no condition is named like that; there are: {', '.join(c.name for c in CONDITIONS)}")
    with bar() as told:
        report = campaign(views, seed, kinds, chosen, counted(told, views * len(kinds) * len(chosen)))
    show(report, json, _print)
    if report["wrong"]:
        raise typer.Exit(1)


COLUMNS = {
    "views": "{views:d}",
    "found %": "{found:.1%}",
    "refused %": "{refused:.1%}",
    "wrong": "{wrong:d}",
    "points px": "{centre_rms_px:.3f}",
    "pose mm": "{pose_mm:.3f}",
    "mrad": "{pose_mrad:.3f}",
    "z": "{z:.2f}",
    "z of the axes": "{least_z:.2f}-{most_z:.2f}",
    "in 95 %": "{coverage_95:.1%}",
    "found ms": "{found_ms:.0f}",
    "refused ms": "{refused_ms:.0f}",
}


def _print(report: dict[str, Any]) -> None:
    console = wide_console()
    lines = [row for row in report["rows"] if row["kind"] == "all"]
    kinds = [{"condition": kind, "expect": "found", **row} for kind, row in report["kinds"].items()]
    for title, first, rows in (
        (f"all kinds of boards, {report['views_per_line']} views of each, RMS errors", "condition", lines),
        ("by kind, where the board is to be found", "kind", kinds),
    ):
        axes = [row["z_axes"] or [None] for row in rows]
        shown = [row | {"least_z": min(z), "most_z": max(z)} for row, z in zip(rows, axes, strict=True)]
        console.print(formed(title, {first: "{condition}", "<to be": "{expect}", **COLUMNS}, shown))
    console.print(
        "simulated pictures: 40 electrons per DN, read noise 0.4 DN. wrong: a point under another's name, or a board "
        "found that is not there."
    )

"""`cell paper`: the paper's figure and table reproduced, each with what was wrong in it."""

from pathlib import Path
from typing import Annotated

import typer

from cell.apps.cli.options import JsonOption
from lab.cli.shown import bar, counted, show

OutOption = Annotated[
    Path | None, typer.Option("--out", help="Folder for the pictures and the numbers as JSON; made if it is not there.")
]
SeedsOption = Annotated[int, typer.Option("--seeds", min=1, max=1000, help="How many simulated heads.")]

paper = typer.Typer(help="The paper, reproduced: its design study and table.", no_args_is_help=True)


@paper.command()
def figure2(json: JsonOption = False, out: OutOption = None) -> None:
    """Figure 2: error over the sensor for 30 and 35 mm of baseline, light on it, and which rule chooses 35 mm. With
    --out it also draws figure2_errors.png."""
    from lab.paper.figure2 import figure2 as numbers

    _show(numbers(), json, out, "figure2")
    if out is not None:
        from lab.paper.figure2 import draw

        path = out / "figure2_errors.png"
        draw(path)
        # On standard error, so that JSON on standard output stays alone.
        typer.echo(f"drawn: {path}", err=True)


@paper.command()
def table1(seeds: SeedsOption = 20, json: JsonOption = False, out: OutOption = None) -> None:
    """Section 5.2 and Table 1 in simulation: before and after calibration, outliers found, beside the paper's."""
    from lab.paper.table1 import table1 as campaign

    with bar() as told:
        result = campaign(range(seeds), counted(told, seeds))
    _show(result, json, out, "table1")


def _show(result: dict[str, object], json: bool, out: Path | None, name: str) -> None:
    show(result, json)
    if out is not None:
        from cell.base.storage import write_json

        out.mkdir(parents=True, exist_ok=True)
        write_json(out / f"{name}.json", result)

"""`cell bench reconstruction`: outliers, holes and speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from cell.cli.options import JsonOption, SeedOption, print_json, wide_console

if TYPE_CHECKING:
    from rich.console import Console


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command("reconstruction")(reconstruction)


def reconstruction(seed: SeedOption = 1, json: JsonOption = False) -> None:
    """Outliers found, holes filled and milliseconds after the last frame, on synthetic clouds of known truth."""
    from rich.console import Console
    from rich.progress import Progress

    from cell.lab.bench.reconstruction import run

    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=1.0)
        report = run(seed, lambda share, text: progress.update(task, completed=share, description=text))
        progress.update(task, completed=1.0, description="done")
    if json:
        print_json(report)
        return
    _show(wide_console(), report)


def _show(console: Console, report: dict[str, Any]) -> None:
    _table(
        console,
        "outliers in 300 × 480 points; beside a statistical removal on the same points",
        report["outliers"],
        {
            "surface": "{surface}",
            "kind": "{kind}",
            "share": "{share:.0%}",
            "recall": "{recall:.4f}",
            "precision": "{precision:.4f}",
            "ms": "{ms:.0f}",
            "statistical: recall": "{statistical_recall:.3f}",
            "precision ": "{statistical_precision:.3f}",
            "ms ": "{statistical_ms:.0f}",
        },
    )
    _table(
        console,
        "holes, interpolated; z is the error in units of the stated sigma",
        report["holes"],
        {
            "surface": "{surface}",
            "lines × rows": "{lines} × {rows}",
            "filled": "{filled:.1%}",
            "error rms in um": "{error_rms_um:.1f}",
            "z rms": "{z_rms:.2f}",
            "ms": "{ms:.0f}",
        },
    )
    _table(
        console,
        "speed",
        report["speed"],
        {
            "camera": "{width}×{rows}",
            "lines": "{lines}",
            "points": "{points}",
            "ms per profile as it arrives": "{ms_per_profile:.2f}",
            "ms after the last frame": "{ms_after_last_frame:.0f}",
            "of the processor, all threads": "{processor_ms_after_last_frame:.0f}",
        },
    )


def _table(console: Console, title: str, rows: list[dict[str, Any]], columns: dict[str, str]) -> None:
    from rich.table import Table

    table = Table(title=title)
    for name in columns:
        table.add_column(name.strip(), justify="left" if name in ("surface", "kind") else "right")
    for row in rows:
        table.add_row(*(pattern.format(**row) for pattern in columns.values()))
    console.print(table)

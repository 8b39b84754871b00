"""The protocol of a commissioning: one page that can be printed, with every figure, its limit, and the pictures."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.apps.commission.check import CommissionCheck, Progress, bounds
from cell.base.version import release
from cell.config.cell_config import CellConfig
from cell.run.report.page import render
from drivers.interfaces import Reading

FILE = "protocol.html"


@dataclass(frozen=True)
class ProtocolRow:
    """A check and how it stands, with its stored `result` (None: not done); `readings` beside what is allowed."""

    check: CommissionCheck
    standing: str
    result: Mapping[str, Any] | None
    readings: Sequence[tuple[Reading, str]]
    pictures: Sequence[Path]


def write_protocol(progress: Progress, checks: Sequence[CommissionCheck], config: CellConfig) -> Path:
    """Write the page beside the record of the progress; returns its path."""
    cell = progress.cell
    world = (f"{name} {value}" for name, value in cell.items() if name != "simulated" and value is not None)
    text = render(
        __package__,
        "protocol.html.jinja",
        cell=config.cell.name,
        simulated=bool(cell.get("simulated")),
        world=", ".join(world),
        written=time.strftime("%Y-%m-%d %H:%M:%S"),
        release=release(),
        rows=[_row(progress, check, progress.standing(check, config)) for check in checks],
        mended=progress.mended,
    )
    path = progress.folder / FILE
    path.write_text(text, encoding="utf-8")
    return path


def _row(progress: Progress, check: CommissionCheck, standing: str) -> ProtocolRow:
    result = progress.result(check.name)
    kept = result or {"readings": [], "pictures": []}
    readings = [Reading(row["what"], row["value"], row["unit"], row["least"], row["most"]) for row in kept["readings"]]
    pictures = [path for name in kept["pictures"] if (path := progress.folder / name).is_file()]
    return ProtocolRow(check, standing, result, [(reading, bounds(reading)) for reading in readings], pictures)

"""The cell: configuration, geometry, vision, calibration, reconstruction, inversion, motion, steps, supervisor.

`from cell import Cell` is the supervisor's way in; it is imported when it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.job_run import RunOutcome as RunOutcome
    from cell.supervisor import Cell as Cell

__all__ = ["Cell", "RunOutcome"]


def __getattr__(name: str) -> object:
    match name:
        case "Cell":
            from cell.supervisor import Cell

            return Cell
        case "RunOutcome":
            from cell.job_run import RunOutcome

            return RunOutcome
    raise AttributeError(f"module 'cell' has no attribute {name!r}")

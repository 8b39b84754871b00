"""The cell: configuration, geometry, vision, calibration, reconstruction, inversion, motion, steps, supervisor.

`from cell import Cell` is the supervisor's way in; it is imported when it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.supervisor import Cell as Cell
    from cell.supervisor import RunOutcome as RunOutcome

__all__ = ["Cell", "RunOutcome"]


def __getattr__(name: str) -> object:
    if name in __all__:
        from cell import supervisor

        return getattr(supervisor, name)
    raise AttributeError(f"module 'cell' has no attribute {name!r}")

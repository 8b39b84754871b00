"""The cell: configuration, geometry, vision, calibration, reconstruction, inversion, motion, steps, supervisor.

`from cell import Cell` is the supervisor's way in, and `from cell import RefusedError` gets any error of the one tree
in `drivers.errors`; both are imported when they are first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.run.job_run import RunOutcome as RunOutcome
    from cell.run.session.supervisor import Cell as Cell
    from drivers.errors import (
        Aborted,
        CalibrationStale,
        CellError,
        ConfigError,
        DeadlineError,
        DeviceError,
        DeviceFault,
        InterlockError,
        Interrupted,
        LimitError,
        NotConnectedError,
        NotObservable,
        RefusedError,
    )
    from statemachine.script import Again as Again
    from statemachine.script import Script as Script

__all__ = [
    "Aborted",
    "Again",
    "CalibrationStale",
    "Cell",
    "CellError",
    "ConfigError",
    "DeadlineError",
    "DeviceError",
    "DeviceFault",
    "InterlockError",
    "Interrupted",
    "LimitError",
    "NotConnectedError",
    "NotObservable",
    "RefusedError",
    "RunOutcome",
    "Script",
]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'cell' has no attribute {name!r}")
    match name:
        case "Cell":
            from cell.run.session.supervisor import Cell

            return Cell
        case "RunOutcome":
            from cell.run.job_run import RunOutcome

            return RunOutcome
        case "Again" | "Script":
            from statemachine import script

            return getattr(script, name)
    from drivers import errors

    return getattr(errors, name)


def __dir__() -> list[str]:
    return __all__

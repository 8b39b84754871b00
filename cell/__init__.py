"""The public door of the cell: `from cell import Cell` is the supervisor's way in.

Each name is imported when it is first asked for: the supervisor, runs and their events, scripts, steps and kinds of
jobs, makes of devices, and the errors of the one tree in `drivers.errors`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.measure.inversion.place_pose import PlacePose
    from cell.procedures.arm.photograph import BoardFix
    from cell.procedures.placed_part import PlacedPart
    from cell.procedures.steps.drive_to_target import VehicleArrival
    from cell.procedures.steps.kinds import PLACE, Kind
    from cell.procedures.steps.place import PlaceResult
    from cell.procedures.steps.reconstruct import Reconstruction
    from cell.procedures.steps.workplace import JobStep
    from cell.procedures.sweep.stored_sweep import SweepRecord
    from cell.run.batch import BatchOutcome, Distribution
    from cell.run.events import (
        Confirmed,
        ConfirmNeeded,
        FaultMet,
        GoesOn,
        Held,
        Noted,
        RunEnded,
        RunEvent,
        SafeStopped,
        StateChanged,
        StepDone,
        StepFailed,
        StepProgress,
        StepStarted,
    )
    from cell.run.job_run import RunOutcome
    from cell.run.runs import Run
    from cell.run.session.supervisor import Cell
    from drivers.arm.make import ArmOutputClawConfig
    from drivers.common.units import quantity, whole
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
        MisplacedError,
        NotConnectedError,
        NotObservable,
        RefusedError,
    )
    from drivers.make import (
        ArmConfig,
        CameraConfig,
        ClawConfig,
        LaserConfig,
        Make,
        OnArm,
        RailConfig,
        Surroundings,
        VehicleConfig,
    )
    from statemachine.runner import Again, Script
    from statemachine.step import Step

_PLACES = {
    "cell.run.session.supervisor": ("Cell",),
    "cell.run.job_run": ("RunOutcome",),
    "cell.run.batch": ("BatchOutcome", "Distribution"),
    "cell.run.runs": ("Run",),
    "cell.run.events": (
        "ConfirmNeeded", "Confirmed", "FaultMet", "GoesOn", "Held", "Noted", "RunEnded", "RunEvent", "SafeStopped",
        "StateChanged", "StepDone", "StepFailed", "StepProgress", "StepStarted",
    ),
    "statemachine.runner": ("Again", "Script"),
    "statemachine.step": ("Step",),
    "cell.procedures.steps.workplace": ("JobStep",),
    "cell.procedures.steps.kinds": ("Kind", "PLACE"),
    "cell.procedures.arm.photograph": ("BoardFix",),
    "cell.procedures.sweep.stored_sweep": ("SweepRecord",),
    "cell.procedures.steps.reconstruct": ("Reconstruction",),
    "cell.measure.inversion.place_pose": ("PlacePose",),
    "cell.procedures.steps.place": ("PlaceResult",),
    "cell.procedures.placed_part": ("PlacedPart",),
    "cell.procedures.steps.drive_to_target": ("VehicleArrival",),
    "drivers.arm.make": ("ArmOutputClawConfig",),
    "drivers.make": (
        "Make", "OnArm", "Surroundings",
        "ArmConfig", "CameraConfig", "ClawConfig", "LaserConfig", "RailConfig", "VehicleConfig",
    ),
    "drivers.common.units": ("quantity", "whole"),
    "drivers.errors": (
        "Aborted", "CalibrationStale", "CellError", "ConfigError", "DeadlineError", "DeviceError", "DeviceFault",
        "InterlockError", "Interrupted", "LimitError", "MisplacedError", "NotConnectedError", "NotObservable",
        "RefusedError",
    ),
}  # fmt: skip

__all__ = [
    "PLACE", "Aborted", "Again", "ArmConfig", "ArmOutputClawConfig", "BatchOutcome", "BoardFix", "CalibrationStale",
    "CameraConfig", "Cell", "CellError", "ClawConfig", "ConfigError", "ConfirmNeeded", "Confirmed", "DeadlineError",
    "DeviceError", "DeviceFault", "Distribution", "FaultMet", "GoesOn", "Held", "InterlockError", "Interrupted",
    "JobStep", "Kind", "LaserConfig", "LimitError", "Make", "MisplacedError", "NotConnectedError", "NotObservable",
    "Noted", "OnArm", "PlacePose", "PlaceResult", "PlacedPart", "RailConfig", "Reconstruction", "RefusedError", "Run",
    "RunEnded", "RunEvent", "RunOutcome", "SafeStopped", "Script", "StateChanged", "Step", "StepDone", "StepFailed",
    "StepProgress", "StepStarted", "Surroundings", "SweepRecord", "VehicleArrival", "VehicleConfig", "quantity",
    "whole",
]  # fmt: skip


def __getattr__(name: str) -> object:
    for place, names in _PLACES.items():
        if name in names:
            return getattr(import_module(place), name)
    raise AttributeError(f"module 'cell' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__

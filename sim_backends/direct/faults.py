"""The faults that devices without wires can be made to have: those of the models. A wire's own need the wire."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim_backends.faults import ARM_FAULTS, CAMERA_FAULTS, FAULT_NAMES, TARGET_CAMERA_FAULTS
from sim_backends.models.rail import FAULTS as RAIL_MODEL_FAULTS
from sim_backends.models.vehicle import FAULTS as VEHICLE_FAULTS

if TYPE_CHECKING:
    from sim_backends.direct.cell import DirectCell

RAIL_FAULTS = ("rail.reset", *RAIL_MODEL_FAULTS)
NAMES = (*ARM_FAULTS, *RAIL_FAULTS, *VEHICLE_FAULTS, *CAMERA_FAULTS, *TARGET_CAMERA_FAULTS)
ON_WIRES = tuple(name for name in FAULT_NAMES if name not in NAMES)
"""Faults of a wire: of a reply, or of a bus."""


def require(name: str) -> None:
    """ValueError unless the fault `name` can be caused without wires."""
    if name in ON_WIRES:
        raise ValueError(
            f"{name} is a fault of the wire, and on the virtual clock there is none between the cell and its devices; "
            "use --clock wall"
        )
    if name not in NAMES:
        raise ValueError(f"unknown fault {name!r}; known: {', '.join(NAMES)}")


def clear(cell: DirectCell) -> None:
    """Take away all causes of faults, as a person would: buttons are released, motors are well again."""
    cell.world.arm.clear()
    cell.world.vehicle.clear(cell.clock.now())
    cell.world.rail.clear(cell.clock.now())


def cause(cell: DirectCell, name: str) -> None:
    """Cause the fault `name`, of the scan camera where it says only `camera.`."""
    require(name)
    if name in ARM_FAULTS:
        cell.world.arm.fault(name.removeprefix("arm."))
    elif name in RAIL_MODEL_FAULTS:
        cell.world.rail.fault(name, cell.clock.now())
    elif name in RAIL_FAULTS:
        cell.rail.reset()
    elif name in VEHICLE_FAULTS:
        cell.world.vehicle.fault(name, cell.clock.now())
    elif name in CAMERA_FAULTS:
        cell.scan_camera.model.fault(name, 1)
    else:
        cell.target_camera.model.fault(name.removeprefix("target_"), 1)

"""A simulated cell in this process: one seeded world, its clock, and its devices behind the drivers' interfaces.

Time moves when somebody waits: a sleep, a motion's `wait`, a picture's exposure. So the product runs on it unchanged,
as fast as the machine computes, and the same for the same seed.

The faults that devices without wires can be made to have: those of the models. A wire's own need the wire."""

from __future__ import annotations

from typing import Protocol

from sim_backends.clock import SteppedClock
from sim_backends.direct.arm import DirectArm
from sim_backends.direct.camera import DirectCamera
from sim_backends.direct.clock import VirtualClock
from sim_backends.direct.product import DirectSetup
from sim_backends.direct.rail import DirectRail
from sim_backends.direct.vehicle import DirectVehicle
from sim_backends.faults import (
    ARM_FAULTS,
    CAMERA_FAULTS,
    FAULT_NAMES,
    RAIL_MODEL_FAULTS,
    TARGET_CAMERA_FAULTS,
    VEHICLE_MODEL_FAULTS,
)
from sim_backends.world.drawing import STOCK, Drawing
from sim_backends.world.scene import stream
from sim_backends.world.world import World, truth

RAIL_FAULTS = ("rail.reset", *RAIL_MODEL_FAULTS)
NAMES = (*ARM_FAULTS, *RAIL_FAULTS, *VEHICLE_MODEL_FAULTS, *CAMERA_FAULTS, *TARGET_CAMERA_FAULTS)
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
    elif name in VEHICLE_MODEL_FAULTS:
        cell.world.vehicle.fault(name, cell.clock.now())
    elif name in CAMERA_FAULTS:
        cell.scan_camera.model.fault(name, 1)
    else:
        cell.target_camera.model.fault(name.removeprefix("target_"), 1)


LONGEST_TICK_S = 0.05
"""Between two ticks of models at rest."""


class Ticking(Protocol):
    """A device whose commands have to be renewed, or judged, as time goes by."""

    @property
    def tick_s(self) -> float:
        """Longest time between two ticks that what it does now allows, s."""

    def before_tick(self, t: float) -> None:
        """Command the model for the time up to `t`."""

    def after_tick(self, t: float) -> None:
        """See what became of it at `t`."""


class DirectCell:
    """The world of one seed and level, with its devices."""

    def __init__(self, setup: DirectSetup, seed: int, level: str = "nominal", drawing: Drawing = STOCK) -> None:
        """Raises ValueError for an unknown level, or what `World` says of the drawing."""
        self._time = SteppedClock()
        self.world = World(seed, level, drawing=drawing, clock=self._time)
        self.clock = VirtualClock(self._time, self._tick)
        wire = stream(seed, "lockstep.wire")
        self.arm = DirectArm("arm", self.world.arm, self.clock, setup.arm)
        self.rail = DirectRail("rail", self.world.rail, self.clock, setup.rail, wire)
        self.vehicle = DirectVehicle("vehicle", self.world.vehicle, self.clock, setup.vehicle)
        self.scan_camera = DirectCamera("scan_camera", "scan", self.world, self.clock, setup=setup.camera, wire=wire)
        self.target_camera = DirectCamera("target_camera", "target", self.world, self.clock, setup.camera, wire=wire)
        self._ticking: tuple[Ticking, ...] = (self.arm, self.vehicle)

    def truth(self) -> dict[str, object]:
        """Everything true about the world now; see `sim_backends.world.world`."""
        return truth(self.world)

    def fault(self, name: str) -> None:
        """Cause the fault `name`, one of `faults.NAMES`; ValueError for one that is not, or needs a wire."""
        cause(self, name)

    def clear_faults(self) -> None:
        """Take away all causes of faults."""
        clear(self)

    def _tick(self, until: float) -> None:
        """Let the world's time pass by one tick, as fine as what moves needs, at most up to `until` s."""
        t = min(until, self._time.now() + min(LONGEST_TICK_S, *(device.tick_s for device in self._ticking)))
        for device in self._ticking:
            device.before_tick(t)
        self._time.step_to(t)
        self.world.arm.tick(t)
        self.world.vehicle.tick(t)
        for device in self._ticking:
            device.after_tick(t)

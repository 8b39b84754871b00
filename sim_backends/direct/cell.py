"""A simulated cell in this process: one seeded world, its clock, and its devices behind the drivers' interfaces.

Time moves when somebody waits: a sleep, a motion's `wait`, a picture's exposure. So the product runs on it unchanged,
as fast as the machine computes, and the same for the same seed. Of faults there are those of the models.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from drivers.arm.limits import ArmLimits
from drivers.clock import Clock
from sim_backends.clock import SteppedClock
from sim_backends.direct.arm import DirectArm
from sim_backends.direct.camera import DirectCamera
from sim_backends.direct.rail import DirectRail, RailSetup
from sim_backends.direct.vehicle import DirectVehicle, VehicleSetup
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


Check = Callable[[], None]
Ring = Callable[[], float | None]


class VirtualClock(Clock):
    """World time as the host's clock, at rate 1: whoever waits on it lets the world's time pass, tick by tick. One
    thread moves the time at a time. A thread that looks around while it waits does so after each tick of its own."""

    def __init__(self, time: SteppedClock, tick: Callable[[float], None]) -> None:
        """`tick(until)` lets the world go on by one tick, at most to `until` s."""
        super().__init__()
        self._time = time
        self._tick = tick
        self._moving = threading.Lock()
        self._checking = threading.local()
        self._alarms: dict[Ring, float] = {}

    def now(self) -> float:
        """World time in s."""
        return self._time.now()

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of the world pass. Raises what the look-out of this thread raises (see `looking`)."""
        until = self.now() + seconds
        while self._step(until):
            self.check()

    def wait(self, event: threading.Event, timeout: float) -> bool:
        """Let time pass until `event` is set, at most `timeout` s; True when it was set."""
        until = self.now() + timeout
        while not event.is_set() and self._step(until):
            self.check()
        return event.is_set()

    @contextmanager
    def checking(self, check: Check) -> Iterator[None]:
        """Inside this context `check()` is called after each tick that this thread waits for, in place of an outer one.
        What it raises comes out of the wait."""
        outer = getattr(self._checking, "check", None)
        self._checking.check = check
        try:
            yield
        finally:
            self._checking.check = outer

    def check(self) -> None:
        """Look around now, if this thread does that at all."""
        check: Check | None = getattr(self._checking, "check", None)
        if check is not None:
            check()

    def _step(self, until: float) -> bool:
        with self._moving:
            if self._time.now() >= until:
                return False
            self._tick(until)
        for ring in [ring for ring, due in list(self._alarms.items()) if due <= self._time.now()]:
            # One that waits lets others ring.
            if self._alarms.pop(ring, None) is None:
                continue
            again: float | None = 0.0
            try:
                again = ring()
            finally:
                # Whoever rings may be ended by what another one finds.
                if again is not None:
                    self._alarms[ring] = self.now() + again
        return True

    def ring_in(self, seconds: float, ring: Ring) -> None:
        """Have `ring` called then, by whoever lets the time pass; again after as many seconds as it returns."""
        self._alarms[ring] = self.now() + seconds

    @contextmanager
    def alarm(self, seconds: float, ring: Ring) -> Iterator[None]:
        """See `Clock.alarm`; rung by whoever lets the time pass, after the tick that brings it there."""
        self.ring_in(seconds, ring)
        try:
            yield
        finally:
            self._alarms.pop(ring, None)


@dataclass(frozen=True)
class DirectSetup:
    """What the devices are given; of the arm its limits, and the outputs that are off after a recovery."""

    limits: ArmLimits
    safe_off: tuple[int, ...]
    rail: RailSetup
    vehicle: VehicleSetup


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
        self.arm = DirectArm("arm", self.world.arm, self.clock, limits=setup.limits, safe_off=setup.safe_off)
        self.rail = DirectRail("rail", self.world.rail, self.clock, setup.rail, wire)
        self.vehicle = DirectVehicle("vehicle", self.world.vehicle, self.clock, setup.vehicle)
        self.scan_camera = DirectCamera("scan_camera", "scan", self.world, self.clock, wire=wire)
        self.target_camera = DirectCamera("target_camera", "target", self.world, self.clock, wire=wire)
        self._ticking: tuple[Ticking, ...] = (self.arm, self.vehicle)
        self.clock.ring_in(0.0, self.rail.poll)

    def truth(self) -> dict[str, object]:
        """Everything true about the world now; see `sim_backends.world.world`."""
        return truth(self.world)

    def fault(self, name: str) -> None:
        """Cause a fault, the scan camera's where it says only `camera.`; ValueError for one that is not in `NAMES`."""
        require(name)
        now = self.clock.now()
        if name in ARM_FAULTS:
            self.world.arm.fault(name.removeprefix("arm."))
        elif name in RAIL_MODEL_FAULTS:
            self.world.rail.fault(name, now)
        elif name in RAIL_FAULTS:
            self.rail.reset()
        elif name in VEHICLE_MODEL_FAULTS:
            self.world.vehicle.fault(name, now)
        elif name in CAMERA_FAULTS:
            self.scan_camera.model.fault(name, 1)
        else:
            self.target_camera.model.fault(name.removeprefix("target_"), 1)

    def clear_faults(self) -> None:
        """Take away all causes of faults, as a person would: buttons are released, motors are well again."""
        now = self.clock.now()
        self.world.arm.clear()
        self.world.vehicle.clear(now)
        self.world.rail.clear(now)

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

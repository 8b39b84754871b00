"""A simulated cell in lock step: the world's models behind the devices' interfaces, without wires and without waiting.

Time moves when somebody waits: a sleep, a motion's `wait`, a picture's exposure. The product's own steps, planning and
estimators run on it unchanged, as fast as the machine computes, and the same for the same seed.
"""

from __future__ import annotations

import threading
from typing import Protocol

from cell.config import CellConfig
from cell.device_config import of_make
from cell.devices.assembly import Devices
from cell.devices.built_in import ArmOutputClawConfig, ArmOutputLaserConfig, TmclRailConfig
from cell.devices.gate import Gate
from cell.lab.bench.lockstep_arm import LockstepArm
from cell.lab.bench.lockstep_camera import LockstepCamera
from cell.lab.bench.lockstep_rail import LockstepRail
from cell.lab.bench.lockstep_vehicle import LockstepVehicle
from drivers.clock import Clock
from drivers.switches import ArmSwitchedClaw, ArmSwitchedLaser
from sim_backends.clock import SteppedClock
from sim_backends.world.scene import stream
from sim_backends.world.world import World

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


class LockstepClock(Clock):
    """The host's clock: reads the world's, and waiting on it lets the world's time pass."""

    def __init__(self, cell: LockstepCell) -> None:
        super().__init__()
        self._cell = cell

    def now(self) -> float:
        """World time in s."""
        return self._cell.world.clock.now()

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of the world pass."""
        if seconds > 0:
            self._cell.advance(self.now() + seconds)

    def wait(self, event: threading.Event, timeout: float) -> bool:
        """Let `timeout` s pass unless `event` is set: nobody else can set it meanwhile."""
        if not event.is_set():
            self.sleep(timeout)
        return event.is_set()


class LockstepCell:
    """The world of one seed and level, and its devices as the cell's steps take them."""

    def __init__(self, config: CellConfig, seed: int, level: str = "nominal", surface: str = "pot") -> None:
        """Raises ValueError for an unknown level or surface."""
        self._time = SteppedClock()
        self.world = World(seed, level, surface=surface, clock=self._time)
        self.clock = LockstepClock(self)
        wire = stream(seed, "lockstep.wire")
        arm = LockstepArm("arm", self.world.arm, self.clock, config)
        rail = LockstepRail("rail", self.world.rail, self.clock, of_make(config.rail, TmclRailConfig), wire)
        light, claw = of_make(config.laser, ArmOutputLaserConfig), of_make(config.claw, ArmOutputClawConfig)
        vehicle = LockstepVehicle("vehicle", self.world.vehicle, self.clock, config.vehicle)
        self.devices = Devices(
            clock=self.clock,
            gate=Gate(),
            arm=arm,
            rail=rail,
            vehicle=vehicle,
            scan_camera=LockstepCamera("scan_camera", "scan", self.world, self.clock, wire),
            target_camera=LockstepCamera("target_camera", "target", self.world, self.clock, wire),
            laser=ArmSwitchedLaser("laser", arm, light.output),
            claw=ArmSwitchedClaw("claw", arm, claw.output, claw.feedback, clock=self.clock),
        )
        self._ticking: tuple[Ticking, ...] = (arm, vehicle)

    def advance(self, until: float) -> None:
        """Let the world's time pass up to `until` s, in ticks that are as fine as what moves needs."""
        while (now := self._time.now()) < until:
            t = min(until, now + min(LONGEST_TICK_S, *(device.tick_s for device in self._ticking)))
            for device in self._ticking:
                device.before_tick(t)
            self._time.step_to(t)
            self.world.arm.tick(t)
            self.world.vehicle.tick(t)
            for device in self._ticking:
                device.after_tick(t)

    def identities(self) -> dict[str, str]:
        """Serial numbers by device name, as a calibration is tied to them."""
        devices = self.devices
        named = {"arm": devices.arm, "rail": devices.rail}
        cameras = {"scan_camera": devices.scan_camera, "target_camera": devices.target_camera}
        return {name: device.identity().serial for name, device in {**named, **cameras}.items()}

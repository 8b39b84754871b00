"""The gate through which all motion, the laser and the claw are begun: shut for work that is to end.

A stop ends what moves, but a step that plans or settles at that moment would begin its next motion after it. Work
therefore enters the gate with its cancel token: once that is cancelled, or the cell was stopped, it begins nothing
any more, in whatever thread it still goes on.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from drivers.arm.motion import UrMotion
from drivers.arm.ur import UrArm
from drivers.errors import Aborted
from drivers.interfaces import Vector
from drivers.rail.motion import RailMotion
from drivers.rail.sweep import RailSweep
from drivers.rail.tmcl import TmclRail
from drivers.switches import ArmSwitchedClaw, ArmSwitchedLaser
from drivers.vehicle.agilex import AgilexVehicle
from statemachine.cancel import CancelToken

Made = TypeVar("Made")


class Gate:
    """Counts the stops; each thread that works remembers the count at which it entered, and its token."""

    def __init__(self) -> None:
        self._stops = 0
        self._entered = threading.local()

    def enter(self, token: CancelToken) -> None:
        """Begin new work in this thread, which `token` ends."""
        self._entered.stops = self._stops
        self._entered.token = token

    def shut(self) -> None:
        """Bar all work that has entered so far. Comes before the devices are stopped."""
        self._stops += 1

    def require(self) -> None:
        """Raise `Aborted` when this thread's work is to end or the cell was stopped since it entered.

        A thread that never entered is not barred.
        """
        token: CancelToken | None = getattr(self._entered, "token", None)
        if token is not None and token.reason is not None:
            raise Aborted(f"{token.reason}; nothing new is begun")
        if getattr(self._entered, "stops", self._stops) != self._stops:
            raise Aborted("the cell was stopped; nothing new is begun")

    def begin(self, start: Callable[[], Made], undo: Callable[[], None]) -> Made:
        """`start()`, unless the cell was stopped; undone at once when it is stopped meanwhile."""
        self.require()
        made = start()
        try:
            self.require()
        except Aborted:
            undo()
            raise
        return made


class GatedArm(UrArm):
    """The arm, its motions begun through a gate."""

    gate: Gate

    def move_joints(self, joints: Vector, speed: float, acceleration: float) -> UrMotion:
        """See `UrArm.move_joints`."""
        begin = super().move_joints
        return self.gate.begin(lambda: begin(joints, speed, acceleration), self.stop)

    def move_linear(self, flange: Vector, speed: float, acceleration: float) -> UrMotion:
        """See `UrArm.move_linear`."""
        begin = super().move_linear
        return self.gate.begin(lambda: begin(flange, speed, acceleration), self.stop)

    def follow(self, times: Vector, joints: Vector, force_limit: float | None = None) -> UrMotion:
        """See `UrArm.follow`."""
        begin = super().follow
        return self.gate.begin(lambda: begin(times, joints, force_limit), self.stop)


class GatedRail(TmclRail):
    """The rail, its motions begun through a gate."""

    gate: Gate

    def home(self) -> RailMotion:
        """See `TmclRail.home`."""
        return self.gate.begin(super().home, self.stop)

    def move_to(self, position: float, speed: float | None = None) -> RailMotion:
        """See `TmclRail.move_to`."""
        begin = super().move_to
        return self.gate.begin(lambda: begin(position, speed), self.stop)

    def sweep(self, start: float, stop: float, speed: float) -> RailSweep:
        """See `TmclRail.sweep`."""
        begin = super().sweep
        return self.gate.begin(lambda: begin(start, stop, speed), self.stop)


class GatedVehicle(AgilexVehicle):
    """The vehicle, taken into command and driven through a gate."""

    gate: Gate

    def enable(self) -> None:
        """See `AgilexVehicle.enable`."""
        self.gate.begin(super().enable, self.brake)

    def drive(self, speed: float, yaw_rate: float) -> None:
        """See `AgilexVehicle.drive`."""
        begin = super().drive
        self.gate.begin(lambda: begin(speed, yaw_rate), self.stop)


class GatedLaser(ArmSwitchedLaser):
    """The laser, lit through a gate."""

    gate: Gate

    @contextmanager
    def lit(self) -> Iterator[None]:
        """See `ArmSwitchedLaser.lit`."""
        self.gate.require()
        with super().lit():
            self.gate.require()
            yield


class GatedClaw(ArmSwitchedClaw):
    """The claw, closed and opened through a gate; what it did is not undone, because that could drop the part."""

    gate: Gate

    def grip(self, timeout: float = 2.0) -> None:
        """See `ArmSwitchedClaw.grip`."""
        self.gate.require()
        super().grip(timeout)

    def release(self, timeout: float = 2.0) -> None:
        """See `ArmSwitchedClaw.release`."""
        self.gate.require()
        super().release(timeout)

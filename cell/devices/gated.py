"""The devices behind the gate: each holds a device of any make and lets begin only what the gate lets begin.

Reading, stopping and closing always pass. What a make offers beyond its interface is asked of the bare device (`bare`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Generic, TypeVar

from cell.devices.gate import Gate
from drivers.clock_map import Latch
from drivers.interfaces import (
    Arm,
    ArmMotion,
    ArmState,
    Claw,
    Device,
    Identity,
    Laser,
    Motion,
    Rail,
    RailState,
    Sweep,
    Vector,
    Vehicle,
    VehicleState,
)

Bare = TypeVar("Bare", bound=Device)


class Gated(Generic[Bare]):
    """What all of them share: `bare` is the device, `gate` what its commands pass."""

    def __init__(self, bare: Bare, gate: Gate) -> None:
        self.bare = bare
        self.gate = gate
        self.name = bare.name
        self.statistics = bare.statistics

    def identity(self) -> Identity:
        """See `Device.identity`."""
        return self.bare.identity()

    def ping(self) -> float:
        """See `Device.ping`."""
        return self.bare.ping()

    def stop(self) -> None:
        """See `Device.stop`."""
        self.bare.stop()

    def close(self) -> None:
        """See `Device.close`."""
        self.bare.close()


class GatedArm(Gated[Arm]):
    """The arm, its motions and its recovery begun through a gate."""

    def state(self, max_age: float = 0.1) -> ArmState:
        """See `Arm.state`."""
        return self.bare.state(max_age)

    def record(self) -> AbstractContextManager[list[ArmState]]:
        """See `Arm.record`."""
        return self.bare.record()

    def latch_clock(self) -> Latch:
        """See `Arm.latch_clock`."""
        return self.bare.latch_clock()

    def move_joints(self, joints: Vector, speed: float, acceleration: float) -> ArmMotion:
        """See `Arm.move_joints`."""
        return self.gate.begin(lambda: self.bare.move_joints(joints, speed, acceleration), self.bare.stop)

    def move_linear(self, flange: Vector, speed: float, acceleration: float) -> ArmMotion:
        """See `Arm.move_linear`."""
        return self.gate.begin(lambda: self.bare.move_linear(flange, speed, acceleration), self.bare.stop)

    def follow(self, times: Vector, joints: Vector, force_limit: float | None = None) -> ArmMotion:
        """See `Arm.follow`."""
        return self.gate.begin(lambda: self.bare.follow(times, joints, force_limit), self.bare.stop)

    def zero_force(self) -> None:
        """See `Arm.zero_force`."""
        self.bare.zero_force()

    def set_payload(self, mass: float, centre: Vector) -> None:
        """See `Arm.set_payload`."""
        self.bare.set_payload(mass, centre)

    def set_digital_output(self, index: int, value: bool) -> None:
        """See `Arm.set_digital_output`."""
        self.bare.set_digital_output(index, value)

    def digital_input(self, index: int) -> bool:
        """See `Arm.digital_input`."""
        return self.bare.digital_input(index)

    def recover(self, *, confirmed: bool = False) -> None:
        """See `Arm.recover`."""
        self.gate.begin(lambda: self.bare.recover(confirmed=confirmed), self.bare.stop)


class GatedRail(Gated[Rail]):
    """The rail, its motions begun through a gate."""

    def __init__(self, bare: Rail, gate: Gate) -> None:
        super().__init__(bare, gate)
        self.travel = bare.travel

    def state(self) -> RailState:
        """See `Rail.state`."""
        return self.bare.state()

    def home(self) -> Motion:
        """See `Rail.home`."""
        return self.gate.begin(self.bare.home, self.bare.stop)

    def move_to(self, position: float, speed: float | None = None) -> Motion:
        """See `Rail.move_to`."""
        return self.gate.begin(lambda: self.bare.move_to(position, speed), self.bare.stop)

    def sweep(self, start: float, stop: float, speed: float) -> Sweep:
        """See `Rail.sweep`."""
        return self.gate.begin(lambda: self.bare.sweep(start, stop, speed), self.bare.stop)

    def sweep_start(self, start: float, stop: float, speed: float) -> float:
        """See `Rail.sweep_start`."""
        return self.bare.sweep_start(start, stop, speed)


class GatedVehicle(Gated[Vehicle]):
    """The vehicle, taken into command and driven through a gate."""

    def state(self, max_age: float = 0.2) -> VehicleState:
        """See `Vehicle.state`."""
        return self.bare.state(max_age)

    def check(self) -> None:
        """See `Vehicle.check`."""
        self.bare.check()

    def enable(self) -> None:
        """See `Vehicle.enable`."""
        self.gate.begin(self.bare.enable, self.bare.brake)

    def recover(self) -> None:
        """See `Vehicle.recover`."""
        self.gate.begin(self.bare.recover, self.bare.brake)

    def drive(self, speed: float, yaw_rate: float) -> None:
        """See `Vehicle.drive`."""
        self.gate.begin(lambda: self.bare.drive(speed, yaw_rate), self.bare.stop)

    def brake(self) -> None:
        """See `Vehicle.brake`."""
        self.bare.brake()


class GatedLaser(Gated[Laser]):
    """The laser, lit through a gate."""

    @contextmanager
    def lit(self) -> Iterator[None]:
        """See `Laser.lit`."""
        self.gate.require()
        with self.bare.lit():
            self.gate.require()
            yield

    @property
    def is_on(self) -> bool:
        """See `Laser.is_on`."""
        return self.bare.is_on


class GatedClaw(Gated[Claw]):
    """The claw, closed and opened through a gate; what it did is not undone, because that could drop the part."""

    def grip(self, timeout: float = 2.0) -> None:
        """See `Claw.grip`."""
        self.gate.require()
        self.bare.grip(timeout)

    def release(self, timeout: float = 2.0) -> None:
        """See `Claw.release`."""
        self.gate.require()
        self.bare.release(timeout)

    @property
    def holding(self) -> bool:
        """See `Claw.holding`."""
        return self.bare.holding

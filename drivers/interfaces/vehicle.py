"""A vehicle: its feedback, how it drives and brakes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from drivers.interfaces.device import Device


@dataclass(frozen=True)
class VehicleState:
    """Vehicle feedback.

    Odometry is integrated by the driver from the wheel distances since it was opened: x, y in m and yaw in rad in the
    frame where the vehicle stood then; `speed` m/s and `yaw_rate` rad/s as reported. `braked` is None as long as this
    driver has not commanded the brake, and when somebody else may have released it since; `battery_volts` where nobody
    tells it. `trouble` says in words what ends motion, `warnings` what does not. `interruptions` counts how often
    odometry lost its connection to where the vehicle was before, and `interruption` says why it did last.
    """

    stamp: float
    x: float
    y: float
    yaw: float
    speed: float
    yaw_rate: float
    command_mode: bool
    braked: bool | None
    emergency_stop: bool
    error_bits: int
    battery_volts: float | None
    trouble: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    interruptions: int = 0
    interruption: str = ""


class Vehicle(Device, Protocol):
    """A carrier that turns by the speeds of its two sides."""

    def state(self, max_age: float = 0.2) -> VehicleState:
        """The newest feedback, at most `max_age` seconds old, else `DeadlineError`."""

    def check(self) -> None:
        """Raise the `DeviceFault` that the vehicle shows: lost link, silence, emergency stop, error, lost command."""

    def enable(self) -> None:
        """Take command over CAN and release the brake."""

    def recover(self) -> None:
        """Clear what can be cleared and take command again, with the brake locked throughout."""

    def drive(self, speed: float, yaw_rate: float) -> None:
        """Set the velocity that is kept alive until the next call or `stop()`; must be renewed within 0.5 s."""

    def brake(self) -> None:
        """Stop, wait for standstill and lock the brake."""

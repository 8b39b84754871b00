"""How a vehicle of two wheel drives is built: from its metres a second to its drives' numbers, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

VelocityUnit = Literal["counts/s", "rpm", "0.1 rpm", "0.01 rpm", "0.001 rpm"]
SIDES = ("left", "right")
SI_UNITS = {
    "counts/s": 0x00B50300, "rpm": 0x00B44700, "0.1 rpm": 0xFFB44700, "0.01 rpm": 0xFEB44700, "0.001 rpm": 0xFDB44700,
}  # fmt: skip
"""How object 60A9h writes these units (CiA 303-2: decimal prefix, numerator, denominator)."""
_RPM = {"rpm": 1.0, "0.1 rpm": 0.1, "0.01 rpm": 0.01, "0.001 rpm": 0.001}


@dataclass(frozen=True)
class WheelDrives:
    """Two wheel drives, left and right, SI units.

    `nodes` are their numbers on the bus. `gear` is turns of the motor per turn of the wheel, `counts` increments per
    turn of the motor, `reversed` whether the motor turns backwards when the vehicle drives ahead. `acceleration` and
    `deceleration` in m/s² are the ramps that the drives keep, `deceleration` also that of halt and quick stop.
    `brake_output` and `stop_input` are bits of a drive's digital outputs and inputs, or None: then the drive switches
    its brake by itself, or nobody tells of the emergency stop. `brake_locks` and `stop_active` are the levels at which
    the brake is locked and the emergency stop is pressed.
    """

    nodes: tuple[int, int]
    wheel_radius: float
    gear: float
    counts: int
    velocity_unit: VelocityUnit
    reversed: tuple[bool, bool]
    track: float
    acceleration: float
    deceleration: float
    brake_output: int | None = None
    brake_locks: bool = False
    stop_input: int | None = None
    stop_active: bool = True

    @property
    def count_length(self) -> float:
        """Way of a wheel's rim per increment, m."""
        return 2.0 * math.pi * self.wheel_radius / (self.gear * self.counts)

    @property
    def velocity_step(self) -> float:
        """Speed of a wheel's rim per unit of velocity, m/s."""
        turn = 2.0 * math.pi * self.wheel_radius / self.gear
        return turn / self.counts if self.velocity_unit == "counts/s" else _RPM[self.velocity_unit] * turn / 60.0

    def targets(self, speed: float, yaw_rate: float) -> tuple[int, int]:
        """Target velocities of both drives for m/s and rad/s of the vehicle."""
        rims = speed - 0.5 * self.track * yaw_rate, speed + 0.5 * self.track * yaw_rate
        left, right = (
            round(rim / self.velocity_step) * (-1 if back else 1) for rim, back in zip(rims, self.reversed, strict=True)
        )
        return left, right

    def motion(self, velocities: tuple[int, int]) -> tuple[float, float]:
        """Speed in m/s and yaw rate in rad/s of the vehicle from what both drives report."""
        left, right = (
            velocity * self.velocity_step * (-1 if back else 1)
            for velocity, back in zip(velocities, self.reversed, strict=True)
        )
        return 0.5 * (left + right), (right - left) / self.track

    def ramp(self, acceleration: float) -> int:
        """m/s² of the rim as the drives have it: units of velocity per second."""
        return max(1, round(acceleration / self.velocity_step))

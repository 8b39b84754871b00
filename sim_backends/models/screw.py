"""The lead screw of the rail: from motor turns to true carriage travel, with its errors.

Lead error (scale), one periodic error per turn, and backlash as a play that the nut has between the flanks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Screw:
    """Screw of `lead` m per turn; `scale_error` is relative, `periodic` (m) and `backlash` (m) are amplitude and width.

    The phase is that of the periodic error in rad.
    """

    lead: float = 0.002
    scale_error: float = 0.0
    periodic: float = 0.0
    phase: float = 0.0
    backlash: float = 0.0

    def travel(self, nut_turns: float) -> float:
        """Carriage displacement in m for the nut's position in turns."""
        periodic = self.periodic * (math.sin(2.0 * math.pi * nut_turns + self.phase) - math.sin(self.phase))
        return self.lead * (1.0 + self.scale_error) * nut_turns + periodic

    def nut(self, travel: float) -> float:
        """The nut's position in turns for a carriage displacement in m (inverse of `travel`)."""
        lead = self.lead * (1.0 + self.scale_error)
        turns = travel / lead
        for _ in range(20):
            turns += (travel - self.travel(turns)) / lead
        return turns

    def follow(self, nut_turns: float, motor_turns: float) -> float:
        """Where the nut is after the motor has moved monotonically to `motor_turns`, coming from `nut_turns`."""
        half = 0.5 * self.backlash / self.lead
        return min(max(nut_turns, motor_turns - half), motor_turns + half)

    def motor(self, travel: float, direction: int) -> float:
        """The motor's position in turns at which the carriage passes `travel` (m) while moving in `direction` (±1)."""
        return self.nut(travel) + direction * 0.5 * self.backlash / self.lead

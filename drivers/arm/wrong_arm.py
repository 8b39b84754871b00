"""Whether the arm is the one that its user computes with: the flange as reported and as the user's own model has it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from drivers.arm.faults import fault
from drivers.arm.messages import Six, Snapshot
from drivers.arm.trajectory import pose_difference
from drivers.interfaces import Vector

Forward = Callable[[Vector], Vector]
"""Joint angles (6,) in rad to the flange's pose (6,) in the base: x, y, z in m and a rotation vector in rad."""

MOST_WAY, MOST_TURN = 5e-3, math.radians(1.0)
"""How far the two may be apart, m and rad. A factory calibration makes 1.2 mm and 7.7 mrad of it (median)."""


def require_same_flange(device: str, forward: Forward, snapshot: Snapshot) -> None:
    """Raise `DeviceFault` (arm.wrong_kinematics) when the two differ by more than `MOST_WAY` or `MOST_TURN`."""
    way, turn = _difference(forward, snapshot)
    if not _near(way, turn):
        raise fault(
            device,
            "arm.wrong_kinematics",
            f"the flange that it reports is {1e3 * way:.1f} mm and {math.degrees(turn):.2f} deg away from where the "
            f"configured model has it, allowed {1e3 * MOST_WAY:g} mm and {math.degrees(MOST_TURN):g} deg; "
            "nothing was moved",
        )


def flange_agrees(forward: Forward, snapshot: Snapshot) -> bool:
    """True when the two differ by no more than is allowed."""
    return _near(*_difference(forward, snapshot))


def _near(way: float, turn: float) -> bool:
    return way <= MOST_WAY and turn <= MOST_TURN


def _difference(forward: Forward, snapshot: Snapshot) -> tuple[float, float]:
    computed: Six = tuple(float(value) for value in forward(np.array(snapshot.joints)))
    return pose_difference(computed, snapshot.flange)

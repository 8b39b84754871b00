"""Whether the arm is the one that its user computes with: flange and payload as reported and as they should be."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from drivers.arm.faults import fault
from drivers.arm.messages import Six, Snapshot
from drivers.arm.motion import pose_difference
from drivers.interfaces import Vector

Forward = Callable[[Vector], Vector]
"""Joint angles (6,) in rad to the flange's pose (6,) in the base: x, y, z in m and a rotation vector in rad."""

MOST_WAY, MOST_TURN = 0.05e-3, 0.1e-3
"""How far the two may be apart, m and rad. With the same table they agree to the last digits; with the maker's table
instead of the factory's it is 2 to 4 mm and 7 to 15 mrad (docs/reference/protocols.md, section 1)."""

MOST_MASS, MOST_OFFSET = 1e-3, 1e-4
"""How far the payloads may be apart, kg and m: a controller shows what it was given."""


def require_same_flange(device: str, forward: Forward, snapshot: Snapshot, unknown: str = "") -> None:
    """Raise `DeviceFault` (arm.wrong_kinematics) when the two differ by more than `MOST_WAY` or `MOST_TURN`.

    `unknown` says why the controller's own table is not known, if it is not.
    """
    way, turn = _difference(forward, snapshot)
    if _near(way, turn):
        return
    text = (
        f"the flange that it reports is {1e3 * way:.3f} mm and {1e3 * turn:.3f} mrad away from where the cell's model "
        f"has it, allowed {1e3 * MOST_WAY:g} mm and {1e3 * MOST_TURN:g} mrad; nothing was moved"
    )
    if unknown:
        text += (
            f". The arm's own kinematics is not known ({unknown}), so the maker's table was taken. Open that port "
            "between this computer and the controller"
        )
    raise fault(device, "arm.wrong_kinematics", text)


def same_payload(snapshot: Snapshot, payload: tuple[float, Six]) -> bool:
    """True when the controller reckons with `payload`, kg and centre of gravity (3,) in m.

    A centre of zeros is none: the controller keeps the one that it had.
    """
    (mass, centre), (set_mass, set_centre) = snapshot.payload, payload
    near = abs(mass - set_mass) <= MOST_MASS
    return near and (not any(set_centre) or math.dist(centre, set_centre) <= MOST_OFFSET)


def require_same_payload(device: str, snapshot: Snapshot, payload: tuple[float, Six]) -> None:
    """Raise `DeviceFault` (arm.wrong_payload) unless the controller reckons with `payload`."""
    if not same_payload(snapshot, payload):
        shown, wanted = (f"{m:.3f} kg at {[round(1e3 * x, 1) for x in c]} mm" for m, c in (snapshot.payload, payload))
        raise fault(device, "arm.wrong_payload", f"{shown}, set was {wanted}; nothing was moved")


def flange_agrees(forward: Forward, snapshot: Snapshot) -> bool:
    """True when the two differ by no more than is allowed."""
    return _near(*_difference(forward, snapshot))


def _near(way: float, turn: float) -> bool:
    return way <= MOST_WAY and turn <= MOST_TURN


def _difference(forward: Forward, snapshot: Snapshot) -> tuple[float, float]:
    computed: Six = tuple(float(value) for value in forward(np.array(snapshot.joints)))
    return pose_difference(computed, snapshot.flange)

"""The Denavit–Hartenberg table of one six-axis arm as its controller tells it: plain numbers, no kinematics."""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import dataclass

_MOST = {"theta": 100.0, "a": 10.0, "d": 10_000.0, "alpha": 2.0 * math.pi}
"""Larger numbers are garbage. In factory tables d of axes that are almost parallel reaches hundreds of metres."""


@dataclass(frozen=True)
class LinkTable:
    """One number a joint, each tuple (6,): theta and alpha in rad, a and d in m (docs/reference/protocols.md, section
    1).

    A link turns about z by the joint's angle plus theta, moves along z by d, along the new x by a, and turns about it
    by alpha. In a factory table d of joints 2 to 4 may be hundreds of metres and cancel: their axes are almost
    parallel, and where their common normals lie is nearly arbitrary.
    """

    theta: tuple[float, ...]
    a: tuple[float, ...]
    d: tuple[float, ...]
    alpha: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, most in _MOST.items():
            values = getattr(self, name)
            if len(values) != 6 or not all(abs(value) <= most for value in values):
                unit = "m" if name in ("a", "d") else "rad"
                raise ValueError(f"{name} of a link table is {values}; six numbers within ±{most:g} {unit} are needed")

    def hash(self) -> str:
        """Twelve hexadecimal digits that tell this table from every other one, to the last bit."""
        numbers = struct.pack(">24d", *self.theta, *self.a, *self.d, *self.alpha)
        return hashlib.sha256(numbers).hexdigest()[:12]

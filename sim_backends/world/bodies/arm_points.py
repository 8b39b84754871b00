"""The points with a radius that stand for arm, tool and part where the world looks what they meet.

Never larger than the real thing, and coarse on purpose.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_backends.models.arm_kinematics import TABLES
from sim_backends.world.drawing import Drawing

Pose = NDArray[np.float64]
Vector = NDArray[np.float64]

BODIES = ("upper arm", "forearm", "wrist", "claw", "target camera", "scan head", "part")


class _Links(NamedTuple):
    """How far upper arm and forearm lie beside joint 2, along its axis, then the radii of both and of the wrist, m."""

    upper: float
    fore: float
    upper_radius: float
    fore_radius: float
    wrist_radius: float


_SMALL = _Links(0.120, 0.027, 0.048, 0.036, 0.035)
_MIDDLE = _Links(0.138, 0.007, 0.058, 0.045, 0.036)
_LARGE = _Links(0.176, 0.042, 0.065, 0.050, 0.040)
_HEAVY = _Links(0.260, 0.043, 0.080, 0.065, 0.045)
_OF = {
    "UR3": _SMALL, "UR3e": _SMALL, "UR5": _MIDDLE, "UR5e": _MIDDLE, "UR7e": _MIDDLE, "UR10": _LARGE, "UR10e": _LARGE,
    "UR12e": _LARGE, "UR16e": _LARGE, "UR20": _HEAVY, "UR30": _HEAVY,
}  # fmt: skip
"""Shoulder and elbow offsets of the maker's description of each arm (ur_description); radii of the thinner tubes."""


def _corners(low: tuple[float, float, float], high: tuple[float, float, float]) -> Vector:
    return np.array(list(product(*zip(low, high, strict=True))))


class ArmPoints:
    """The points of one cell: `body` (n,) indexes `BODIES`, `radius` (n,) is in m."""

    _CLAW = _corners((-0.028, -0.028, 0.03), (0.028, 0.028, 0.14))
    _TARGET = _corners((-0.02, -0.02, -0.05), (0.02, 0.02, 0.015))

    def __init__(self, drawing: Drawing) -> None:
        """For the arm, the mounted cameras, the laser and the part of `drawing`."""
        cell, station = drawing.cell, drawing.station
        links, d = _OF[cell.arm], TABLES[cell.arm][:, 1]
        # Body, link, offset along its z at the beginning and the end, link of the end, number of points, radius.
        rows = (
            (0, 1, links.upper, links.upper, 2, 8, links.upper_radius),
            (1, 2, links.fore, links.fore, 3, 9, links.fore_radius),
            (2, 3, links.fore + 0.018, d[3] - 0.024, 3, 3, links.wrist_radius),
            (2, 4, 0.0, d[4] - 0.020, 4, 3, links.wrist_radius),
            (2, 5, 0.030, d[5] - 0.055, 5, 2, links.wrist_radius),
        )
        counts = [row[5] for row in rows]
        self.body = np.repeat([*(row[0] for row in rows), 3, 4, 5, 6], [*counts, 8, 8, 8, 8])
        self.radius = np.repeat([*(row[6] for row in rows), 0.0], [*counts, 32])
        self._first = np.repeat([row[1] for row in rows], counts)
        self._last = np.repeat([row[4] for row in rows], counts)
        shares = [np.linspace(1.0 / 8 if row[0] == 0 else 0.0, 1.0, row[5]) for row in rows]
        self._share = np.concatenate(shares)[:, None]
        self._offset = np.repeat([row[2] for row in rows], counts)[:, None]
        self._rise = np.repeat([row[3] for row in rows], counts)[:, None]
        target = _moved(self._TARGET, cell.target.mounting)
        self._on_flange = np.concatenate([self._CLAW, target])
        # The camera and its laser, in the camera's frame.
        self._scan = _corners((-cell.baseline - 0.015, -0.02, -0.055), (0.02, 0.02, 0.005))
        x, y, z = station.part_size
        part = _corners((-0.5 * x, -0.5 * y, 0.0), (0.5 * x, 0.5 * y, 0.9 * z))
        self._part = _moved(part, station.flange_from_part)

    def at(self, frames: Pose, flange_from_scan: Pose, held: bool) -> Vector:
        """The points (n, 3) in the arm's base; `frames` (7, 4, 4) are those of base and links, the last the flange's.

        A part that the claw does not hold is left out: its points are at the flange, inside the wrist.
        """
        along = frames[self._first, :3, 2]
        start = frames[self._first, :3, 3] + self._offset * along
        end = frames[self._last, :3, 3] + self._rise * along
        flange = frames[6]
        part = self._part if held else np.zeros_like(self._part)
        tool = np.concatenate([self._on_flange, _moved(self._scan, flange_from_scan), part])
        return np.concatenate([start + self._share * (end - start), _moved(tool, flange)])


def _moved(points: Vector, a_from_b: Pose) -> Vector:
    moved: Vector = points @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return moved

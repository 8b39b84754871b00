"""The way that the arm follows now, as points of its flange, for drawing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cell.devices.gated import GatedArm
from cell.motion.arm_models import arm_kinematics

if TYPE_CHECKING:
    from cell.supervisor import Cell

MOST_POINTS = 40


class PlannedWay:
    """Of one cell's arm; None where there is no such way."""

    def __init__(self, cell: Cell) -> None:
        arm = cell.devices.arm if "arm" in cell.devices else None
        self._arm = arm if isinstance(arm, GatedArm) else None
        if self._arm is not None:
            self._kinematics = arm_kinematics(cell.config.arm.model, self._arm.link_table())
        self._shown: object = None
        self._number = 0
        self._points: list[list[float]] = []

    def newest(self) -> dict[str, Any] | None:
        """Its number, which grows with each, and at most 40 points (x, y, z) in the base, m."""
        way = None if self._arm is None else self._arm.planned
        if way is None:
            return None
        if way is not self._shown:
            chosen = np.linspace(0, len(way) - 1, min(MOST_POINTS, len(way))).round().astype(int)
            self._points = [self._kinematics.fk(way[k]).translation.round(4).tolist() for k in chosen]
            self._shown, self._number = way, self._number + 1
        return {"n": self._number, "points": self._points}

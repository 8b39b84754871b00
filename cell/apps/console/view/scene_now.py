"""What a run has told of the place, the part and the arm's way, in the arm's base: for drawing, beside `scene`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from cell.apps.console.view.scene import numbers
from cell.devices.gate.interlocks import Situation
from cell.motion.bodies import PLACED, Body, station_bodies
from drivers.interfaces import Vector

MOST_POINTS = 80
"""Points of a way that are drawn."""


class SceneNow:
    """Reads a cell's interlocks, which planner and steps tell; called by one thread, keeps nobody waiting."""

    def __init__(self) -> None:
        self._way: Vector | None = None
        self._path: dict[str, Any] | None = None
        self._count = 0
        # The same table that the planner is given, at the place's own frame.
        self._table = station_bodies(pin.SE3.Identity(), pin.SE3.Identity())[0]

    def as_dict(self, situation: Situation) -> dict[str, Any]:
        """`place` (base_from_place) once the board was measured, `part` (base_from_part) once it was let go, each 16
        numbers or None, and `path`, the flange's points (m) on the way that the arm follows now, or None."""
        told = {body.name: body for body in situation.station}
        return {
            "place": self._place(told.get(self._table.name)),
            "part": _part(told.get(PLACED)),
            "path": self._followed(situation),
        }

    def _place(self, table: Body | None) -> list[float] | None:
        return None if table is None else numbers(table.placement * self._table.placement.inverse())

    def _followed(self, situation: Situation) -> dict[str, Any] | None:
        way, motion = situation.way, situation.last
        if way is None or motion is None or motion.done:
            return None
        if way is not self._way:
            self._way, self._count = way, self._count + 1
            chosen = np.linspace(0, len(way) - 1, min(len(way), MOST_POINTS)).round().astype(int)
            points = [situation.forward(joints).translation.round(4).tolist() for joints in way[chosen]]
            self._path = {"n": self._count, "points": points}
        return self._path


def _part(placed: Body | None) -> list[float] | None:
    """The part's frame lies in its mating face, half its height below the body's middle."""
    if placed is None:
        return None
    return numbers(placed.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.5 * placed.size[2]])))

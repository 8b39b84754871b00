"""What else is in the way: boxes that a configuration (on the vehicle) or a job (at the station) names.

The planner keeps the arm away from them, the gate every other command, and the way of the vehicle leaves room for them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated

import pinocchio as pin

from cell.base.addresses import Name
from cell.base.toml_file import Table
from cell.base.units import quantity
from cell.makes.records import Pose
from cell.motion.bodies import BASE, Body, box

Side = Annotated[float, quantity("mm", 1, 10_000)]


class Obstacle(Table):
    """A box with edges `size` along the axes of its pose, which is that of its middle."""

    name: Annotated[str, Name]
    size: tuple[Side, Side, Side]


class VehicleObstacle(Obstacle):
    """One that goes with the vehicle: a control box, a rack."""

    base_from_centre: Pose


class StationObstacle(Obstacle):
    """One that stands at the station: a fixture, a neighbour's machine."""

    place_from_centre: Pose


def once_each(obstacles: Sequence[Obstacle]) -> None:
    """Raise `ValueError` when two have one name."""
    names = [obstacle.name for obstacle in obstacles]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"obstacle {', '.join(twice)} is there twice; give each a name of its own")


def vehicle_obstacles(obstacles: Iterable[VehicleObstacle]) -> list[Body]:
    """The bodies of those on the vehicle, fixed to the arm's base."""
    return [box(f"obstacle {o.name}", BASE, o.base_from_centre.se3(), o.size) for o in obstacles]


def station_obstacles(obstacles: Iterable[StationObstacle], base_from_place: pin.SE3) -> list[Body]:
    """The bodies of those at the station, by the place frame's pose in the arm base."""
    return [
        box(f"station obstacle {o.name}", BASE, base_from_place * o.place_from_centre.se3(), o.size) for o in obstacles
    ]

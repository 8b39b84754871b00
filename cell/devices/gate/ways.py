"""Which bodies the arm would bring together on the way that a command asks for, whoever asks, planned or not.

Known here are the arm, its tool, the vehicle, the boards on its deck and the obstacles of the configuration. The part
in the claw or where it was put, and the station with the job's obstacles are among them where a run has told of them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from cell.config.cell_config import CellConfig
from cell.config.mounting import deck_plates, mounted
from cell.config.obstacles import vehicle_obstacles
from cell.devices.gate.interlocks import DeviceCommand
from cell.measure.geometry.poses import from_ur
from cell.motion.arm_models import arm_kinematics
from cell.motion.bodies import TOUCHES, Body, arm_bodies, tool_bodies, vehicle_bodies
from cell.motion.clearance import first_touch
from cell.motion.collision import CollisionModel, Pair
from cell.motion.kinematics import Joints
from cell.motion.point_speed import PointSpeed, carried_points
from drivers.interfaces import Vector
from drivers.link_table import LinkTable

MARGIN_M = 0.002
"""Less than the planner keeps, so that what it finds free is not refused for a rounding."""
LINE_STEP_M, LINE_STEP_RAD = 0.01, 0.03


class Ways:
    """The ways of an arm whose controller told `table`, or none, through its own cell."""

    def __init__(self, config: CellConfig, table: LinkTable | None = None) -> None:
        self._config = config
        self._obstacles = vehicle_obstacles(config.obstacle)
        self._one_at_a_time = threading.Lock()
        self.kinematics = arm_kinematics(config.arm.model, table)
        # One of its own: where the arm stands is asked while a way is reckoned.
        self._looking = threading.Lock()
        self._standing = arm_kinematics(config.arm.model, table)
        self._known: tuple[tuple[Body, ...], CollisionModel] | None = None

    def _among(self, others: tuple[Body, ...]) -> CollisionModel:
        if self._known is None or self._known[0] != others:
            tool = tool_bodies(None, None, mounted(self._config))
            own = [*arm_bodies(self._config.arm.model), *tool, *vehicle_bodies(deck_plates(self._config))]
            self._known = others, CollisionModel(self.kinematics, [*own, *self._obstacles, *others], MARGIN_M)
        return self._known[1]

    def forward(self, joints: Vector) -> pin.SE3:
        """base_from_flange at joint angles (6,) in rad; callable from any thread."""
        with self._looking:
            return self._standing.fk(joints)

    def clear(self, start: Vector, command: DeviceCommand, others: Sequence[Body] = ()) -> list[Pair]:
        """The pairs that come closer than 2 mm on the way from `start`, (6,) rad, with these `others` about.

        What is closer at the beginning may part, but not come nearer. With a force limit the part may be set down.
        Raises `Unreachable` when the arm cannot follow a straight line.
        """
        with self._one_at_a_time:
            allowed = () if command.arguments.get("force_limit") is None else TOUCHES
            way = np.array([start, *self._way(start, command)])
            touch = first_touch(self._among(tuple(others)), way, allowed, opening=True)
            return [] if touch is None else touch.pairs

    def slowed(self, start: Vector, goal: Vector, speed: float, carried: Sequence[Body] = ()) -> float:
        """`speed`, rad/s of the joint that turns most from `start` to `goal` (6,), or less: as much as keeps every
        point of the tool, and of what is `carried`, within `arm.max_tool_speed`. One out of range is left to the arm.
        """
        way = float(np.abs(np.asarray(goal) - start).max())
        if not 0.0 < speed <= self._config.arm.max_joint_speed or way == 0.0:
            return speed
        with self._one_at_a_time:
            points = carried_points(self._among(tuple(carried)).bodies)
            bound = PointSpeed(self.kinematics, points, self._config.arm.max_tool_speed)
            return min(speed, way * bound.fraction_speed(np.asarray(start), np.asarray(goal)))

    def _way(self, start: Joints, command: DeviceCommand) -> Iterator[Joints]:
        arguments = command.arguments
        match command.name:
            case "move_joints":
                yield np.asarray(arguments["joints"])
            case "move_linear":
                yield from self._line(start, from_ur(arguments["flange"]))
            case _:
                yield from np.asarray(arguments["joints"])

    def _line(self, joints: Joints, goal: pin.SE3) -> Iterator[Joints]:
        begin = self.kinematics.fk(joints)
        apart = begin.inverse() * goal
        length, turn = np.linalg.norm(apart.translation), np.linalg.norm(pin.log3(apart.rotation))
        count = max(1, int(np.ceil(max(length / LINE_STEP_M, turn / LINE_STEP_RAD))))
        for k in range(1, count + 1):
            pose = pin.SE3(begin.rotation @ pin.exp3(pin.log3(apart.rotation) * (k / count)), np.zeros(3))
            pose.translation = begin.translation + (goal.translation - begin.translation) * (k / count)
            joints = self.kinematics.track(pose, joints)
            yield joints

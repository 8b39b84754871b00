"""Jogging: one small motion of one device, checked against its limits before anything moves."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from cell.config.job import Job, load_job
from cell.measure.geometry.poses import from_parts, from_ur
from cell.measure.vision.board.view import parse_board
from cell.procedures.arm.photograph import drawn_interim_view, look_pose
from cell.procedures.calibrate.interim import resting_pose
from cell.procedures.drive.driving import Planar, RelativeOdometry, drive_line, driven, turn_to
from cell.run.recorded_work import WorkContext
from drivers.common.units import parse_quantity
from drivers.errors import ConfigError, DeviceFault, LimitError
from drivers.interfaces import Arm, ArmSafety, Vector
from statemachine.step import Observer

if TYPE_CHECKING:
    from cell.run.session.supervisor import Cell

MAX_LENGTH_MM = 500.0
MAX_ANGLE_DEG = 90.0
JOG_SPEED = 0.05  # m/s
_WATCHED = {"arm": ("vehicle", "vehicle_parked"), "vehicle": ("arm", "arm_stowed")}
"""Arm and vehicle move only while the other one is safe: which that is, and the interlock that says so."""
_USAGE = "rail +5mm · arm z -10mm · arm rx +2deg · arm j3 +5deg · vehicle +0.1m · vehicle +5deg"


Begun = tuple[Vector, pin.SE3]
"""Joint angles (6,), rad, and base_from_flange where the arm stood at first."""


@dataclass(frozen=True)
class Jog:
    """What to move: `axis` is empty, x y z rx ry rz (arm base axes) or j1 … j6; `amount` in m or rad."""

    device: str
    axis: str
    amount: float


def needed_for(wish: Jog, lift: Sequence[str] = ()) -> tuple[str, ...]:
    """The devices that have to be connected for it when the interlocks in `lift` are lifted."""
    other, rule = _WATCHED.get(wish.device, ("", ""))
    return (wish.device, other) if other and rule not in lift else (wish.device,)


def parse_jog(device: str, words: list[str]) -> Jog:
    """Read "arm z -10mm" and the like; raises `ConfigError` that shows how it is written."""
    if device == "arm" and len(words) >= 2:
        axis, text = words[0].lower(), "".join(words[1:])
        if re.fullmatch(r"[xyz]", axis):
            return Jog(device, axis, _amount(text, "mm"))
        if re.fullmatch(r"r[xyz]|j[1-6]", axis):
            return Jog(device, axis, _amount(text, "deg"))
    if device == "rail" and words:
        return Jog(device, "", _amount("".join(words), "mm"))
    if device == "vehicle" and words:
        text = "".join(words)
        turning = text.lower().endswith(("deg", "rad"))
        return Jog(device, "yaw" if turning else "x", _amount(text, "deg" if turning else "m"))
    raise ConfigError(f"cannot jog {' '.join([device, *words])!r}; write it like: {_USAGE}")


def _amount(text: str, unit: str) -> float:
    bound = {"mm": MAX_LENGTH_MM, "deg": MAX_ANGLE_DEG, "m": MAX_LENGTH_MM / 1e3}[unit]
    try:
        return parse_quantity(text, unit, -bound, bound)
    except ValueError as error:
        raise ConfigError(f"jog by {error}; write it like: {_USAGE}") from error


def jog(cell: Cell, wish: Jog, job: str | Path = "pot", observer: Observer | None = None) -> dict[str, str]:
    """Perform it and give where the device is afterwards, in words with units. Ctrl-C stops the cell. The vehicle is
    also jogged with the arm in the looking pose of `job`."""
    stops = cell.stops
    loaded, _ = load_job(job)
    begun: list[Begun] = []
    work = partial(moved, cell, wish, loaded, begun=begun)
    return cell.perform("jog", work, observer, {"moved": f"{wish.device} {wish.axis}".strip()}, stops)


def moved(cell: Cell, wish: Jog, job: Job, context: WorkContext, begun: list[Begun] | None = None) -> dict[str, str]:
    """The same as part of a run that goes on. `begun` keeps where the arm began, for who does it again after a fault:
    it then goes on to the same goal."""
    match wish.device:
        case "rail":
            return _jog_rail(cell, wish)
        case "arm":
            return _jog_arm(cell, wish, [] if begun is None else begun)
        case _:
            mounting = cell.config.target_camera.flange_from_camera.se3()
            look = look_pose(cell.config, job, parse_board(job.board.spec), mounting)
            cell.devices.interlocks.may_drive_with(f"the looking pose of job {job.job.name}", look)
            cell.devices.interlocks.may_drive_with("over the fine board", resting_pose(drawn_interim_view(cell.config)))
            return _jog_vehicle(cell, wish, context.check)


def _jog_rail(cell: Cell, wish: Jog) -> dict[str, str]:
    rail = cell.devices.rail
    here = rail.state()
    said = {} if here.homed else {"homing": "the rail was not homed: searched its switch first"}
    if not here.homed:
        rail.home().wait(60.0)
        here = rail.state()
    rail.move_to(here.position + wish.amount).wait(60.0)
    return {**said, "rail": f"{1e3 * here.position:.3f} mm → {1e3 * rail.state().position:.3f} mm"}


def begin_program(arm: Arm) -> None:
    """Begin the arm's control program anew where a stop, a silent computer or somebody at the pendant has ended it. A
    lost link is connected again. Raises `DeviceFault` where that takes a person's word, as after a protective stop."""
    if not arm_is_ready(arm):
        arm.recover()


def arm_is_ready(arm: Arm) -> bool:
    """Whether it is connected, not stopped for safety, and its control program runs."""
    try:
        state = arm.state()
    except DeviceFault as fault:
        if fault.code not in ("arm.link_lost", "arm.link_closed"):
            raise
        return False
    return state.controlled and state.safety is ArmSafety.NORMAL


def _jog_arm(cell: Cell, wish: Jog, begun: list[Begun]) -> dict[str, str]:
    if "vehicle" in cell.devices:
        cell.devices.vehicle.recover()
    begin_program(cell.devices.arm)
    mover = cell.mover(None)
    if not begun:
        begun.append((mover.joints.copy(), from_ur(cell.devices.arm.state().flange)))
    ((joints, start),) = begun
    if wish.axis.startswith("j"):
        number = int(wish.axis[1]) - 1
        goal = joints.copy()
        goal[number] += wish.amount
        low, high = mover.kinematics.limits.lower[number], mover.kinematics.limits.upper[number]
        if not low <= goal[number] <= high:
            raise LimitError(
                "arm",
                f"joint {number + 1} to {math.degrees(goal[number]):.1f} deg is outside its limits "
                f"({math.degrees(low):.0f} to {math.degrees(high):.0f} deg); jog by less",
            )
        mover.to_joints(goal)
        reached = mover.joints
        return {wish.axis: f"{math.degrees(joints[number]):.3f} deg → {math.degrees(reached[number]):.3f} deg"}
    direction = np.eye(3)["xyz".index(wish.axis[-1])]
    if wish.axis.startswith("r"):
        goal_pose = from_parts(start.translation, pin.exp3(direction * wish.amount) @ start.rotation)
    else:
        goal_pose = from_parts(start.translation + direction * wish.amount, start.rotation)
    mover.line(goal_pose, JOG_SPEED)
    reached_pose = from_ur(cell.devices.arm.state().flange)
    shown = ", ".join(f"{1e3 * v:.2f}" for v in reached_pose.translation)
    way = np.linalg.norm(reached_pose.translation - start.translation)
    return {"flange": f"({shown}) mm in the base, moved {1e3 * way:.2f} mm"}


def _jog_vehicle(cell: Cell, wish: Jog, check: Callable[[], None]) -> dict[str, str]:
    vehicle, clock = cell.devices.vehicle, cell.devices.clock

    def look() -> None:
        check()
        cell.whereabouts.count()

    with driven(vehicle):
        odometry = RelativeOdometry(vehicle)
        if wish.axis == "yaw":
            turn_to(vehicle, odometry, wish.amount, clock, look)
        else:
            drive_line(vehicle, odometry, Planar(wish.amount, 0.0, 0.0), speed=JOG_SPEED, clock=clock, check=look)
    pose = odometry.pose()
    return {
        "vehicle": f"moved {1e3 * pose.x:.1f} mm ahead, {1e3 * pose.y:.1f} mm left, {math.degrees(pose.yaw):.2f} deg"
    }

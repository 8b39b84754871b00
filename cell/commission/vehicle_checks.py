"""The vehicle: which way and how far its wheels take it, by their counters and by the station's board."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pinocchio as pin

from cell.calibration.store import nominal_camera
from cell.commission.camera_checks import PITCH_OFF
from cell.commission.check import Check, Finding, Result
from cell.commission.desk import Desk
from cell.commission.mounting import axes_from_shifts
from cell.geometry.poses import from_parts, from_ur
from cell.steps.approach import Planar, RelativeOdometry, drive_line
from cell.steps.camera_poses import look_pose
from cell.vision import board_pose, find_board, parse_board
from drivers.errors import CellError, DeviceFault, RefusedError

WAY, SPEED = 0.050, 0.050
MOST_OFF_MM = 5.0
MOST_OFF_SHARE = 0.4
"""By how much, relative, what the camera sees may differ from what the wheels count: from afar it sees little."""
SHIFT = 0.060
"""By how much, m, the flange is shifted to measure the station's board, each way."""
LEAST_SEEN = 0.012
"""A way that the camera sees must be this long, m, to say which way it went."""
PHOTO_RATE = 10.0


def _wheels(desk: Desk, result: Result) -> None:
    config, devices = desk.config, desk.devices
    if not config.vehicle.DRIVES:
        result.notes.append("the vehicle is fixed: nothing drives")
        return
    job = desk.job
    mounting = config.target_camera.flange_from_camera.se3()
    look = look_pose(config, job, parse_board(job.board.spec), mounting)
    devices.interlocks.may_drive_with(f"the looking pose of job {job.job.name}", look)
    desk.fold()
    desk.mover().to(look, "the looking pose")
    desk.confirm("vehicle", "its wheels, straight ahead", f"{1e3 * WAY:.0f} mm and back", f"{1e3 * SPEED:.0f} mm/s")
    before = _board_at(desk, result, "vehicle-before")
    if before is not None:
        _pitch(desk, result, look)
    devices.vehicle.enable()
    try:
        odometry = RelativeOdometry(devices.vehicle)
        drive_line(devices.vehicle, odometry, Planar(WAY, 0.0, 0.0), SPEED, devices.clock, _look(desk))
        devices.vehicle.brake()
        there = odometry.pose()
        after = _board_at(desk, result, "vehicle-after")
        devices.vehicle.enable()
        drive_line(devices.vehicle, odometry, Planar(0.0, 0.0, 0.0), SPEED, devices.clock, _look(desk))
    finally:
        devices.vehicle.brake()
    back = odometry.pose()
    low, high = 1e3 * WAY - MOST_OFF_MM, 1e3 * WAY + MOST_OFF_MM
    result.measure("ahead, by the wheels' counters", 1e3 * there.x, "mm", least=low, most=high)
    result.measure("aside, by the wheels' counters", 1e3 * there.y, "mm", least=-MOST_OFF_MM, most=MOST_OFF_MM)
    result.measure("turned, by the wheels' counters", math.degrees(there.yaw), "deg", least=-1.5, most=1.5)
    result.measure("after the way back", 1e3 * back.x, "mm", least=-MOST_OFF_MM, most=MOST_OFF_MM)
    if before is None or after is None:
        result.notes.append("the station's board was not seen from here, so a person was asked")
        seen = desk.person.sees(f"Did the vehicle go {1e3 * WAY:.0f} mm the way its arm looks, and back again?")
        result.measure("a person saw it go ahead", float(seen), "", least=1.0)
        return
    # The board stands: what comes nearer to the base is the way of the vehicle, in the vehicle's axes.
    way = config.arm.vehicle_from_base.se3().rotation @ (before - after)
    result.measure("ahead, by the station's board", 1e3 * way[0], "mm")
    ratio = float(way[0]) / there.x
    if np.linalg.norm(way) < LEAST_SEEN:
        raise RefusedError(
            f"the wheels counted {1e3 * there.x:.0f} mm, the camera saw the board {1e3 * way[0]:.0f} mm nearer; "
            "see that the wheels take the vehicle along, and that it is not jacked up"
        )
    if way[0] < 0.0:
        result.find(
            Finding(
                "arm.vehicle_from_base", "the vehicle goes the other way than the arm has it: away from the board",
                f"{1e3 * there.x:+.0f} mm", f"{1e3 * way[0]:+.0f} mm",
                "Turn arm.vehicle_from_base by 180 deg about z, or have the vehicle's maker reverse its drives.",
            )
        )  # fmt: skip
    else:
        result.measure(
            "that over the wheels' way", ratio, "", least=1.0 - MOST_OFF_SHARE, most=1.0 + MOST_OFF_SHARE,
            remedy="See the wheels' diameter, whether they slip, and the station's board.",
        )  # fmt: skip


def _pitch(desk: Desk, result: Result, look: pin.SE3) -> None:
    """How large the station's board is, by the ways of the arm before it; the arm is back at `look` afterwards."""
    board, mover = parse_board(desk.job.board.spec), desk.mover()
    flanges, boards = [], []
    for shift in (np.zeros(3), *(sign * SHIFT * axis for axis in np.eye(3) for sign in (1.0, -1.0))):
        desk.look_around()
        try:
            mover.to(look * from_parts(shift), "before the station's board")
            frame = desk.devices.target_camera.grab()
            seen = board_pose(find_board(frame.image, board), nominal_camera(desk.config.target_camera))
        except DeviceFault:
            raise
        except CellError:
            continue
        flanges.append(from_ur(desk.devices.arm.state().flange))
        boards.append(seen.camera_from_board)
    mover.to(look, "the looking pose")
    try:
        across = axes_from_shifts(flanges, boards).across
    except RefusedError as refused:
        result.notes.append(f"the station's board could not be measured from here: {refused}")
        return
    result.measure("station's board by the arm's measure over its name", across, "")
    if abs(across - 1.0) > PITCH_OFF:
        result.find(
            Finding(
                "board.spec of the job",
                "the station's board has another pitch than its name says, by the ways of the arm",
                f"{1e3 * board.pitch:g} mm", f"{1e3 * board.pitch * across:.1f} mm",
                "Measure from the first to the last point with a ruler, and name the board so in the job's file: the "
                "vehicle drives by it.",
            )
        )  # fmt: skip


def _look(desk: Desk) -> Callable[[], None]:
    def look() -> None:
        desk.look_around()
        desk.cell.whereabouts.count()

    return look


def _board_at(desk: Desk, result: Result, name: str) -> np.ndarray | None:
    """The station's board (3,) in the base, roughly; None when it is not seen."""
    config, devices = desk.config, desk.devices
    camera = devices.target_camera
    camera.configure(config.target_camera.photo_exposure, PHOTO_RATE)
    devices.clock.sleep(config.arm.settle_time)
    frame = camera.grab()
    try:
        view = find_board(frame.image, parse_board(desk.job.board.spec))
        pose = board_pose(view, nominal_camera(config.target_camera))
    except RefusedError:
        desk.keep(result, name, frame)
        return None
    desk.keep(result, name, frame, view.pixels)
    flange = from_ur(devices.arm.state().flange)
    found: pin.SE3 = flange * config.target_camera.flange_from_camera.se3() * pose.camera_from_board
    return np.asarray(found.translation)


CHECKS = [
    Check(
        "vehicle", "Vehicle: its wheels, direction and unit",
        "the arm to the job's looking pose, then the wheels", f"{1e3 * WAY:.0f} mm ahead and back",
        f"{1e3 * SPEED:.0f} mm/s",
        f"{1e3 * WAY:.0f} mm within {MOST_OFF_MM:.0f} mm, straight; the station's board comes nearer",
        ("vehicle", "target_camera", "arm", "job"), ("target_mounting", "outputs"), _wheels,
    ),
]  # fmt: skip

"""The vehicle: which way and how far its wheels take it, by their counters and by the station's board."""

import math
from collections.abc import Callable

import numpy as np
import pinocchio as pin

from cell.apps.commission.check import CommissionCheck, Result
from cell.apps.commission.checks.cameras import PITCH_OFF, renamed
from cell.apps.commission.measuring import axes_from_shifts, eye_of, poses_of, see, shifted_views, views_from
from cell.apps.commission.workplace import CommissionWorkplace
from cell.config.job import job_path, load_job, ships
from cell.measure.vision.board.view import BoardSpec, parse_board
from cell.procedures.arm.photograph import look_pose
from cell.procedures.drive.driving import Planar, RelativeOdometry, drive_line, driven
from drivers.errors import RefusedError
from drivers.interfaces import Frame

WAY, SPEED = 0.050, 0.050
MOST_OFF_MM = 5.0
MOST_OFF_SHARE = 0.4
"""By how much, relative, what the camera sees may differ from what the wheels count: from afar it sees little."""
SHIFT = 0.060
"""By how much, m, the flange is shifted to measure the station's board, each way."""
STRIDE, STRIDE_SPEED, LEAST_LEFT = 0.25, 0.15, 0.40
"""How far the vehicle goes at a time, m, how fast, m/s, and how far it keeps from the job's target, m."""
LEAST_SEEN = 0.012
"""A way that the camera sees must be this long, m, to say which way it went."""


def _wheels(workplace: CommissionWorkplace, result: Result) -> None:
    config, devices = workplace.config, workplace.devices
    if not config.vehicle.DRIVES:
        result.notes.append("the vehicle is fixed: nothing drives")
        return
    workplace.fold()
    workplace.confirm(
        "vehicle", "its wheels, straight ahead", f"{1e3 * WAY:.0f} mm and back", f"{1e3 * SPEED:.0f} mm/s"
    )
    with driven(devices.vehicle):
        odometry = RelativeOdometry(devices.vehicle)
        drive_line(
            devices.vehicle, odometry, Planar(WAY, 0.0, 0.0), SPEED, clock=devices.clock, check=_check(workplace)
        )
        there = odometry.pose()
        seen = workplace.person.sees(f"Did the vehicle go {1e3 * WAY:.0f} mm ahead, the way it goes to the station?")
        drive_line(
            devices.vehicle, odometry, Planar(0.0, 0.0, 0.0), SPEED, clock=devices.clock, check=_check(workplace)
        )
    back = odometry.pose()
    low, high = 1e3 * WAY - MOST_OFF_MM, 1e3 * WAY + MOST_OFF_MM
    result.measure("ahead, by the wheels' counters", 1e3 * there.x, "mm", least=low, most=high)
    result.measure("aside, by the wheels' counters", 1e3 * there.y, "mm", least=-MOST_OFF_MM, most=MOST_OFF_MM)
    result.measure("turned, by the wheels' counters", math.degrees(there.yaw), "deg", least=-1.5, most=1.5)
    result.measure("after the way back", 1e3 * back.x, "mm", least=-MOST_OFF_MM, most=MOST_OFF_MM)
    result.require("a person saw it go ahead", seen)


def _station(workplace: CommissionWorkplace, result: Result) -> None:
    """Nearer to the station in strides until its board is seen; then the arm measures the board, and it the wheels."""
    config, devices, job = workplace.config, workplace.devices, workplace.job
    look = look_pose(config, job, parse_board(job.board.spec), config.target_camera.flange_from_camera.se3())
    devices.interlocks.may_drive_with(f"the looking pose of job {job.job.name}", look)
    if config.vehicle.DRIVES and not workplace.person.does(
        f"The vehicle stands at the start of job {job.job.name}, and the way to the station is clear."
    ):
        raise RefusedError("the vehicle was not brought to the job's start")
    workplace.fold()
    workplace.mover().to(look, "the looking pose")
    odometry = RelativeOdometry(devices.vehicle)
    try:
        before = _until_seen(workplace, result, odometry)
        if before is None:
            raise RefusedError(
                "the station's board was not seen on the way to it: see that it stands where the job has it, that it "
                f"is {job.board.spec}, and that it has light"
            )
        _pitch(workplace, result, look)
        if config.vehicle.DRIVES:
            _by_board(workplace, result, odometry, before)
    finally:
        if config.vehicle.DRIVES:
            workplace.mover().to(look, "the looking pose")
            _drive(workplace, odometry, 0.0)


def _until_seen(workplace: CommissionWorkplace, result: Result, odometry: RelativeOdometry) -> np.ndarray | None:
    """The station's board (3,) in the base once it is seen; None when it is not before the vehicle is near."""
    approach = workplace.job.approach
    way = (Planar.of(approach.start.se3()).inverse() * Planar.of(approach.target.se3())).x
    driven = 0.0
    while (seen := _board_at(workplace, result, "station-board")) is None:
        driven += STRIDE
        if not workplace.config.vehicle.DRIVES or driven > way - LEAST_LEFT:
            return None
        workplace.confirm(
            "vehicle, to the station", "its wheels, in strides, until the board is seen",
            f"at most {way - LEAST_LEFT:.1f} m, and back", f"{1e3 * STRIDE_SPEED:.0f} mm/s",
        )  # fmt: skip
        _drive(workplace, odometry, driven)
    result.measure("driven until the station's board was seen", driven, "m")
    return seen


def _by_board(workplace: CommissionWorkplace, result: Result, odometry: RelativeOdometry, before: np.ndarray) -> None:
    """The wheels' way against the board, which stands: what comes nearer is the way of the vehicle."""
    from_here = odometry.pose().x
    _drive(workplace, odometry, from_here + WAY)
    after = _board_at(workplace, result, "station-board-nearer")
    if after is None:
        raise RefusedError(f"{1e3 * WAY:.0f} mm nearer, the station's board is not seen any more; see its light")
    counted = odometry.pose().x - from_here
    way = workplace.config.arm.vehicle_from_base.se3().rotation @ (before - after)
    result.measure("ahead, by the wheels' counters", 1e3 * counted, "mm")
    result.measure("ahead, by the station's board", 1e3 * way[0], "mm")
    if np.linalg.norm(way) < LEAST_SEEN:
        raise RefusedError(
            f"the wheels counted {1e3 * counted:.0f} mm, the camera saw the board {1e3 * way[0]:.0f} mm nearer; "
            "see that the wheels take the vehicle along, and that it is not jacked up"
        )
    if way[0] < 0.0:
        result.find(
            "arm.vehicle_from_base", "the vehicle goes the other way than the arm has it: away from the board",
            f"{1e3 * counted:+.0f} mm", f"{1e3 * way[0]:+.0f} mm",
            "Turn arm.vehicle_from_base by 180 deg about z, or have the vehicle's maker reverse its drives.",
        )  # fmt: skip
        return
    result.measure(
        "that over the wheels' way", float(way[0]) / counted, "", least=1.0 - MOST_OFF_SHARE, most=1.0 + MOST_OFF_SHARE,
        remedy="See the wheels' diameter, whether they slip, and the station's board.",
    )  # fmt: skip


def _drive(workplace: CommissionWorkplace, odometry: RelativeOdometry, ahead: float) -> None:
    """So far ahead of where the odometry began, m, and braked."""
    vehicle = workplace.devices.vehicle
    with driven(vehicle):
        drive_line(
            vehicle, odometry, Planar(ahead, 0.0, 0.0), STRIDE_SPEED, workplace.devices.clock, check=_check(workplace)
        )


def _pitch(workplace: CommissionWorkplace, result: Result, look: pin.SE3) -> None:
    """How large the station's board is, by the ways of the arm before it; the arm is back at `look` afterwards."""
    board, eye = parse_board(workplace.job.board.spec), eye_of(workplace, "target_camera")
    views = [*views_from(workplace, eye, [look], board), *shifted_views(workplace, eye, look, SHIFT, board)]
    workplace.mover().to(look, "the looking pose")
    try:
        across = axes_from_shifts(*poses_of(views)).across
    except RefusedError as refused:
        result.notes.append(f"the station's board could not be measured from here: {refused}")
        return
    result.measure("station's board by the arm's measure over its name", across, "")
    judge_board(workplace.job_file, board, across, result)


def judge_board(job: str, board: BoardSpec, across: float, result: Result) -> None:
    """What a station's board says that is `across` times as large as `board`, its name in the file of `job`."""
    if abs(across - 1.0) <= PITCH_OFF:
        return
    path, right, stop = job_path(job), renamed(board, across), load_job(job)[0].at_stop
    where = "[board]" if stop is None else f"[board], or the board of stop {stop},"
    remedy = "Measure from the first to the last point with a ruler; the vehicle drives by this board. "
    if ships(path):
        remedy += (
            f"This job ships with the program: `cell init FOLDER --job {path.stem}` writes {path.name} for you to "
            f'change. Below {where} in it write spec = "{right}", and go on with '
            f"`cell commission --job FOLDER/{path.name}`."
        )
    else:
        remedy += f'Below {where} in {path} it has to read spec = "{right}".'
    result.find(
        "board.spec of the job", "the station's board has another pitch than its name says, by the ways of the arm",
        f"{1e3 * board.pitch:g} mm", f"{1e3 * board.pitch * across:.1f} mm", remedy,
        write_job={} if ships(path) or stop else {"board.spec": f'"{right}"'},
    )  # fmt: skip


def _check(workplace: CommissionWorkplace) -> Callable[[], None]:
    def look() -> None:
        workplace.look_around()
        workplace.cell.whereabouts.count()

    return look


def _board_at(workplace: CommissionWorkplace, result: Result, name: str) -> np.ndarray | None:
    """The station's board (3,) in the base, roughly; None when it is not seen."""
    eye = eye_of(workplace, "target_camera")
    workplace.devices.clock.sleep(workplace.config.arm.settle_time)
    try:
        seen = see(workplace, eye, parse_board(workplace.job.board.spec))
    except RefusedError as refused:
        frame = refused.seen["frame"]
        assert isinstance(frame, Frame)
        workplace.keep(result, name, frame)
        return None
    workplace.keep(result, name, seen.frame, seen.view.pixels)
    found: pin.SE3 = seen.base_from_flange * eye.config.flange_from_camera.se3() * seen.camera_from_board
    return np.asarray(found.translation)


CHECKS = [
    CommissionCheck(
        "vehicle", "Vehicle: its wheels, direction and unit",
        "the wheels, with the arm folded", far=f"{1e3 * WAY:.0f} mm ahead and back", fast=f"{1e3 * SPEED:.0f} mm/s",
        limit=f"{1e3 * WAY:.0f} mm within {MOST_OFF_MM:.0f} mm, straight, and seen to go ahead",
        keys=("vehicle",), needs=("target_mounting", "outputs"), work=_wheels,
    ),
]  # fmt: skip
STATION_CHECKS = [
    CommissionCheck(
        "station", "Station: its board by the arm's measure, the wheels by the board",
        "the arm to the job's looking pose; the wheels, until the board is seen, and back",
        far=f"up to {LEAST_LEFT:g} m before the job's target", fast=f"{1e3 * STRIDE_SPEED:.0f} mm/s",
        limit=f"board within {100 * PITCH_OFF:g} % of its name; {1e3 * WAY:.0f} mm of the wheels bring it nearer",
        keys=("vehicle", "target_camera", "arm.vehicle_from_base", "job"), needs=("stops",), work=_station,
    ),
]  # fmt: skip

"""Drive to the target: along the planned approach on odometry, then closed on the board that the camera sees."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import pinocchio as pin

from cell.job import Job
from cell.steps.approach import Odometry, Planar, drive_line, turn_to
from cell.steps.photograph import BoardFix
from drivers.clock import Clock
from drivers.errors import RefusedError
from drivers.interfaces import Vehicle

MAX_TRIES = 5
BACK_UP = 0.45  # m, the run that a second try needs to work off an error to the side


@dataclass(frozen=True, eq=False)
class Arrival:
    """Where the vehicle came to stand, and the last photograph that shows it. Errors in m and rad."""

    base_from_place: pin.SE3
    fix: BoardFix
    error_along: float
    error_across: float
    error_yaw: float
    photographs: int

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "error_along_mm": round(1e3 * self.error_along, 2),
            "error_across_mm": round(1e3 * self.error_across, 2),
            "error_yaw_deg": round(math.degrees(self.error_yaw), 3),
            "photographs": self.photographs,
        }


def drive_to_target(
    job: Job,
    vehicle_from_base: pin.SE3,
    vehicle: Vehicle,
    odometry: Odometry,
    photograph: Callable[[], BoardFix],
    clock: Clock,
    check: Callable[[], None],
    progress: Callable[[float, str], None],
) -> Arrival:
    """Bring the vehicle to the job's target to within its tolerance and brake it there.

    The arm stands in its looking pose already, the vehicle is enabled, and `odometry` knows its place roughly until the
    board is seen. On odometry alone it goes no further than the staging pose.
    `photograph` gives the board in the base; `check` raises when the run is
    to end. Raises `RefusedError` when the tolerance is not met after five tries.
    """

    def place_from_vehicle(fix: BoardFix) -> Planar:
        return Planar.of((vehicle_from_base * fix.base_from_board * job.place_from_board.inverse()).inverse())

    approach = job.approach
    staging, target = Planar.of(approach.staging.se3()), Planar.of(approach.target.se3())
    progress(0.05, "looking whether the board is in sight already")
    try:
        seen = place_from_vehicle(photograph())
        odometry.anchor(seen)
    except RefusedError:
        seen = odometry.pose()
    if (staging.inverse() * seen).x < 0:
        progress(0.1, "driving on odometry")
        drive_line(vehicle, odometry, staging, approach.speed, clock, check)
    for count in range(1, 2 * MAX_TRIES):
        progress(min(0.9, 0.3 + 0.15 * count), "looking at the board")
        clock.sleep(0.3)  # the suspension settles
        fix = photograph()
        base_from_place = fix.base_from_board * job.place_from_board.inverse()
        seen = place_from_vehicle(fix)
        odometry.anchor(seen)
        error = target.inverse() * seen
        near = abs(error.x) < 0.8 * approach.tolerance and abs(error.y) < 0.8 * approach.tolerance
        if near and abs(error.yaw) < 0.5 * approach.tolerance_angle:
            vehicle.brake()
            return Arrival(base_from_place, fix, error.x, error.y, error.yaw, count)
        if near:
            turn_to(vehicle, odometry, target.yaw, clock, check)
        elif abs(error.y) > 0.8 * approach.tolerance and error.x > -0.5 * BACK_UP:
            progress(0.5, "backing up")
            drive_line(vehicle, odometry, target * Planar(-BACK_UP, 0.0, 0.0), approach.speed, clock, check)
            drive_line(vehicle, odometry, target, approach.speed, clock, check)
        else:
            drive_line(vehicle, odometry, target, approach.speed, clock, check)
    vehicle.brake()
    raise RefusedError(
        f"the vehicle stands {1e3 * error.x:.1f} mm along, {1e3 * error.y:.1f} mm across and "
        f"{math.degrees(error.yaw):.2f} deg from its target after {count} photographs, allowed "
        f"{1e3 * approach.tolerance:.0f} mm and {math.degrees(approach.tolerance_angle):.1f} deg; "
        "check the floor and the wheels"
    )

"""The board photograph: the target camera square in front of the board, several pictures, one pose.

They also show whether the vehicle is quiet: while it is not, they are taken anew, up to a few seconds. Later steps
sweep the surface again, and look at the board again where that leaves a motion open: nothing that the arm feels tells a
shift to the side. Several items of a job share a photograph, as long as the vehicle stands.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import difference
from cell.procedures.arm.photograph import MOVED, NEAR, BoardFix, photo_pose, swing_covariance
from cell.procedures.sought_part import around
from cell.procedures.steps.drive_to_target import VehicleArrival
from cell.procedures.steps.workplace import PHOTO_RATE_HZ, JobStep, Workplace
from drivers.errors import Measured, RefusedError
from statemachine.runner import StepContext
from statemachine.step import Step

WAIT_S, WAITS = 1.0, 4
"""How long a vehicle that rocks is waited for, and how often. One that has stopped is quiet by then."""


def photographed(workplace: Workplace, goal: pin.SE3, progress: Callable[[float, str], None]) -> BoardFix:
    """Move to the photograph pose `goal`, base_from_flange, settle, and take the board's pose from a quiet vehicle.

    Refusals (not found, too oblique, residual too high, ambiguous) come from `Workplace.photograph` with their reason,
    those of `until_quiet` likewise.
    """
    workplace.devices.target_camera.configure(workplace.config.target_camera.photo_exposure, PHOTO_RATE_HZ)
    progress(0.1, "arm to the photograph pose")
    workplace.mover.to(goal, "the photograph pose", within=NEAR)
    progress(0.7, "photographing the board")
    vehicle = workplace.config.arm.vehicle_from_base.se3().inverse()
    # One alone does not show whether the vehicle rocks.
    count = max(2, workplace.job.photo.count)
    return until_quiet(vehicle, lambda: workplace.photograph(count), workplace.devices.clock.sleep, progress)


def until_quiet(
    base_from_vehicle: pin.SE3,
    photograph: Callable[[], BoardFix],
    wait: Callable[[float], None],
    progress: Callable[[float, str], None],
) -> BoardFix:
    """What `photograph` gives once it shows no rocking; `wait` is given the seconds to wait before the next.

    Where the vehicle does not come to rest, that is in the covariance, and noted. Raises `RefusedError` where it rocks
    too much to put anything down.
    """
    fix = photograph()
    for _ in range(WAITS):
        if not fix.swung:
            return fix
        progress(0.8, f"waiting until the vehicle is quiet: the board goes to and fro by ±{1e3 * fix.swung:.2f} mm")
        wait(WAIT_S)
        fix = photograph()
    return settled(fix, base_from_vehicle)


def settled(fix: BoardFix, base_from_vehicle: pin.SE3) -> BoardFix:
    """The newest photograph once no more is waited for: what still swings is in its covariance, and noted."""
    if not fix.swung:
        return fix
    unknown = swing_covariance(fix.swung, fix.base_from_board, base_from_vehicle)
    return replace(fix, covariance=fix.covariance + unknown, notes=(rocks_on(fix.swung, WAITS * WAIT_S),))


def rocks_on(swung: float, waited: float) -> str:
    """For people, where the job goes on nevertheless."""
    return (
        f"the vehicle rocks, or the board swings: after {waited:.0f} s of waiting it still goes to and fro by "
        f"±{1e3 * swung:.2f} mm between photographs; what that leaves open is in the stated uncertainty. See what "
        "shakes it, or lower the vehicle's supports"
    )


def require_board_unmoved(
    workplace: Workplace, fix: BoardFix, since: str, progress: Callable[[float, str], None]
) -> None:
    """Photograph the board again from where it was photographed; `since` says when that was, for people.

    Raises `RefusedError` when it stands elsewhere by more than the arm's repeatability and the pictures leave open, and
    what a photograph raises.
    """
    progress(0.0, "looking whether the board still stands where it did")
    board, camera = workplace.board, workplace.devices.target_camera
    workplace.mover.to(
        photo_pose(workplace.job, board, fix.base_from_board, workplace.calibration.target.flange_from_camera),
        "the photograph pose",
    )
    camera.configure(workplace.config.target_camera.photo_exposure, PHOTO_RATE_HZ)
    now = workplace.photograph(workplace.job.photo.count if fix.swung else 1)
    moved = difference(now.base_from_board, fix.base_from_board)
    # How the camera sits on the flange makes both photographs wrong alike.
    spread = fix.covariance + now.covariance - 2.0 * fix.by_mount
    if fix.swung:
        vehicle = workplace.config.arm.vehicle_from_base.se3().inverse()
        spread = spread + swing_covariance(fix.swung, fix.base_from_board, vehicle)
    if (far := float(moved @ np.linalg.solve(spread, moved))) <= MOVED:
        return
    shift, turn = 1e3 * float(np.linalg.norm(moved[:3])), float(np.degrees(np.linalg.norm(moved[3:])))
    raise RefusedError(
        f"the board has moved by {shift:.2f} mm and {turn:.3f} deg since it was photographed, {since}: vehicle or "
        "station does not stand firm, or was bumped. See to it, then run the job again",
        Measured("board moved by", shift, "mm", most=shift * float(np.sqrt(MOVED / far))),
    )


def _run_step(workplace: Workplace, context: StepContext) -> BoardFix:
    arrival, job = context.made(VehicleArrival), workplace.job
    workplace.mover.avoid_station(
        arrival.base_from_place, job, workplace.board, around(workplace.nominal.extent, workplace.ground)
    )
    goal = photo_pose(
        job, workplace.board, arrival.fix.base_from_board, workplace.calibration.target.flange_from_camera
    )
    if workplace.parts_before.more:
        # The next part begins where this one has its photograph.
        workplace.mover.rest_at(goal)
    if arrival.shared is not None:
        workplace.mover.near = arrival.shared.joints
        return workplace.keep_again(arrival.shared)
    fix = photographed(workplace, goal, context.progress)
    for note in fix.notes:
        context.note(text=note)
    return fix


STEP = JobStep(Step("board_photo", 60.0, 2, ("DeadlineError",)), _run_step, BoardFix, needs=(VehicleArrival,))

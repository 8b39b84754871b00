"""The board photograph: the target camera square in front of the board, several pictures, one pose."""

from __future__ import annotations

from collections.abc import Callable

import pinocchio as pin

from cell.steps.camera_poses import photo_pose
from cell.steps.drive_to_target import Arrival
from cell.steps.moves import Mover
from cell.steps.photograph import BoardFix
from cell.steps.step import JobStep
from cell.steps.workplace import PHOTO_RATE_HZ, Workplace
from statemachine.policy import Step
from statemachine.runner import StepContext


def board_photo(
    base_from_flange: pin.SE3,
    mover: Mover,
    photograph: Callable[[int], BoardFix],
    count: int,
    progress: Callable[[float, str], None],
) -> BoardFix:
    """Move to the planned photograph pose, settle, and take the board's pose from `count` photographs.

    Refusals (not found, too oblique, residual too high, ambiguous) come from `photograph` with their reason.
    """
    progress(0.1, "arm to the photograph pose")
    mover.to(base_from_flange, "the photograph pose")
    progress(0.7, "photographing the board")
    return photograph(count)


def _at(here: Workplace, context: StepContext) -> BoardFix:
    arrival, job = context.made(Arrival), here.job
    here.mover.meet_station(arrival.base_from_place, job, here.board, here.nominal.extent)
    goal = photo_pose(job, here.board, arrival.fix.base_from_board, here.calibration.target.flange_from_camera)
    here.devices.target_camera.configure(here.config.target_camera.photo_exposure, PHOTO_RATE_HZ)
    return board_photo(goal, here.mover, here.photograph, job.photo.count, context.progress)


STEP = JobStep(Step("board_photo", 60.0, 2, ("DeadlineError",)), _at, BoardFix, needs=(Arrival,))

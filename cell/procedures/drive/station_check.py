"""Does the station still stand where it was photographed? The board is looked at once more.

Nothing that the arm feels tells a shift to the side between the scan and the placing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cell.measure.geometry.poses import difference
from cell.procedures.arm.photograph import BoardFix, photo_pose, swing_covariance
from cell.procedures.steps.workplace import PHOTO_RATE_HZ, Workplace
from drivers.errors import Measured, RefusedError

MOVED = 22.46
"""Squared Mahalanobis distance of two board poses above which the station has moved: χ² of 6 at 0.999."""


def require_unmoved(here: Workplace, fix: BoardFix, since: str, progress: Callable[[float, str], None]) -> None:
    """Photograph the board again from where it was photographed; `since` says when that was, for people.

    Raises `RefusedError` when it stands elsewhere by more than the arm's repeatability and the pictures leave open, and
    what a photograph raises.
    """
    progress(0.0, "looking whether the board still stands where it did")
    board, camera = here.board, here.devices.target_camera
    here.mover.to(
        photo_pose(here.job, board, fix.base_from_board, here.calibration.target.flange_from_camera),
        "the photograph pose",
    )
    camera.configure(here.config.target_camera.photo_exposure, PHOTO_RATE_HZ)
    now = here.photograph(here.job.photo.count if fix.swung else 1)
    moved = difference(now.base_from_board, fix.base_from_board)
    # How the camera sits on the flange makes both photographs wrong alike.
    spread = fix.covariance + now.covariance - 2.0 * fix.by_mount
    if fix.swung:
        vehicle = here.config.arm.vehicle_from_base.se3().inverse()
        spread = spread + swing_covariance(fix.swung, fix.base_from_board, vehicle)
    if (far := float(moved @ np.linalg.solve(spread, moved))) <= MOVED:
        return
    shift, turn = 1e3 * float(np.linalg.norm(moved[:3])), float(np.degrees(np.linalg.norm(moved[3:])))
    raise RefusedError(
        f"the board has moved by {shift:.2f} mm and {turn:.3f} deg since it was photographed, {since}: vehicle or "
        "station does not stand firm, or was bumped. See to it, then run the job again",
        Measured("board moved by", shift, "mm", most=shift * float(np.sqrt(MOVED / far))),
    )

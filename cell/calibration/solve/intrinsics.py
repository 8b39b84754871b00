"""A camera from pictures of a board alone, without flange poses: adjusted with dots as circles, the lens as needed.

Distortion is kept only when it predicts views that were left out clearly better: a few pictures of a small board fit
any lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.calibration.solve.adjustment import VARIANCE_ROUNDS, Adjustment, Priors
from cell.calibration.solve.blocks import BOARD, CAMERA, HAND, SHARED, State, ViewData
from cell.calibration.solve.starts import LEAST_VIEWS, zhang
from cell.geometry.camera import Array, CameraModel
from cell.vision.board.board import board_pose
from cell.vision.board.view import BoardView
from drivers.errors import RefusedError

# Poses that nothing is known of: each picture's own.
UNKNOWN = Priors(arm_translation=10.0, arm_rotation=10.0)
BETTER = 0.9


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A camera, RMS per component in px: of each view (n,), of all, and of left-out views (NaN with too few)."""

    camera: CameraModel
    view_rms: Array
    rms_px: float
    held_out_px: float
    sigma: Array

    @property
    def point_rms_px(self) -> float:
        """RMS distance of a point in px, OpenCV's figure: √2 times that per component."""
        return float(np.sqrt(2) * self.rms_px)


def calibrate_camera(views: Sequence[BoardView], lens: bool) -> Intrinsics:
    """Zhang's start and the adjustment, with two radial terms (`lens`) or none. Raises RefusedError."""
    camera, _ = zhang(views, lens=lens)
    camera, sigma = _adjusted(views, camera, lens)
    rms = np.array([_pose_rms(view, camera) for view in views])
    weights = np.array([len(v.ids) for v in views])
    total = float(np.sqrt(np.average(rms**2, weights=weights)))
    return Intrinsics(camera, rms, total, _held_out(views, camera, lens), sigma)


def choose_lens(views: Sequence[BoardView]) -> tuple[Intrinsics, Intrinsics]:
    """The camera with the lens model that the views support, and the one without distortion."""
    plain = calibrate_camera(views, lens=False)
    try:
        curved = calibrate_camera(views, lens=True)
    except RefusedError:
        return plain, plain
    return (curved if curved.held_out_px < BETTER * plain.held_out_px else plain), plain


def _adjusted(
    views: Sequence[BoardView], camera: CameraModel, lens: bool, variance_rounds: int = VARIANCE_ROUNDS
) -> tuple[CameraModel, Array]:
    """Camera and the standard deviations (9,) of its parameters."""
    data = [
        ViewData(
            v.object_points,
            v.pixels,
            v.sigma,
            v.dot_radius,
            np.zeros((0, 2)),
            np.zeros(0),
            board_pose(v, camera).camera_from_board.inverse(),
            0.0,
        )
        for v in views
    ]
    free = np.zeros(SHARED, dtype=np.bool_)
    free[CAMERA] = [True] * 4 + [lens] * 2 + [False] * 3
    free[HAND] = free[BOARD] = False
    start = State(camera, None, np.zeros(3), pin.SE3.Identity(), pin.SE3.Identity())
    result = Adjustment(data, free, UNKNOWN).solve(start, variance_rounds)
    return result.state.camera, np.sqrt(np.diag(result.covariance))[CAMERA]


def _pose_rms(view: BoardView, camera: CameraModel) -> float:
    return board_pose(view, camera).rms_px


def _held_out(views: Sequence[BoardView], camera: CameraModel, lens: bool) -> float:
    """RMS in px of each view at its best pose, with the camera adjusted to the others."""
    if len(views) <= LEAST_VIEWS:
        return float("nan")
    folds = min(len(views), 8)
    squares = []
    for fold in range(folds):
        kept = [v for k, v in enumerate(views) if k % folds != fold]
        try:
            other, _ = _adjusted(kept, camera, lens, variance_rounds=1)
            squares += [_pose_rms(v, other) ** 2 for v in views[fold::folds]]
        except RefusedError:
            return float("nan")
    return float(np.sqrt(np.mean(squares)))

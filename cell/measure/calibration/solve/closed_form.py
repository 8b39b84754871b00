"""The closed form with each frame left out in turn: what the joint adjustment has to beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from cell.measure.calibration.observations import ScanObservation
from cell.measure.calibration.solve.adjustment import Adjusted, Adjustment, Priors
from cell.measure.calibration.solve.blocks import BOARD, HAND, PLANE, SHARED, AdjustmentState, ViewData, tangents
from cell.measure.calibration.solve.hand_eye import solve_hand_eye
from cell.measure.calibration.solve.joint import Staged, start_state
from cell.measure.calibration.solve.left_out import LeftOut, Mask, predicted
from cell.measure.calibration.solve.starts import robust_plane, stripe_pixels
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import difference
from cell.measure.vision.stripe_on_board import on_plane
from drivers.errors import RefusedError


@dataclass(frozen=True, eq=False)
class ClosedForm:
    """The closed form as an adjustment would return it, and how the others predict each frame."""

    adjusted: Adjusted
    left: LeftOut


def closed_form(
    observations: Sequence[ScanObservation], staged: Staged, views: list[ViewData], free: Mask
) -> ClosedForm:
    """Hand-eye and light plane of all frames, and of all but one, with the same camera."""
    flanges, boards = [o.base_from_flange for o in observations], staged.camera_from_board
    clouds = points_on_boards(staged, observations)
    state = replace(start_state(staged), flanges=flanges, rails=np.zeros(len(views)))
    states = [_without(state, k, flanges, boards, clouds) for k in range(len(views))]
    figures = np.array(
        [
            [np.inf] * 4 if other is None else predicted(view, flange_seen(state, board), other)
            for view, other, board in zip(views, states, boards, strict=True)
        ]
    )
    steps = np.array([np.zeros(SHARED) if other is None else _step(state, other) for other in states])
    apart = steps - steps.mean(axis=0)
    covariance = (len(views) - 1) / len(views) * apart.T @ apart
    if any(other is None for other in states):
        covariance = np.diag(np.full(SHARED, np.inf))
    dots_px, stripe_m, board_m, squares = figures.T
    known = [other or state for other in states]
    left = LeftOut(
        known, dots_px, stripe_m, board_m, squares=squares, covariance=covariance, by_held=np.zeros((SHARED, SHARED))
    )
    seen = replace(state, flanges=[flange_seen(state, board) for board in boards])
    dots, stripe = Adjustment(views, free, Priors()).residual_rms(seen)
    nothing = np.zeros((SHARED, SHARED))
    return ClosedForm(Adjusted(state, nothing, float("nan"), dots, stripe, priors=Priors(), iterations=0), left)


def flange_seen(state: AdjustmentState, camera_from_board: pin.SE3) -> pin.SE3:
    """The flange pose at which the board would be seen where it is seen."""
    return state.base_from_board * (state.flange_from_camera * camera_from_board).inverse()


def points_on_boards(staged: Staged, observations: Sequence[ScanObservation]) -> list[Array]:
    """The stripe's points (n, 3) on the boards in the camera frame in m, of each observation."""
    made = []
    for k, o in enumerate(observations):
        rows = None if staged.plane is None else staged.plane.rows[k]
        if rows is None or o.profile is None or not len(rows):
            made.append(np.zeros((0, 3)))
        else:
            made.append(on_plane(staged.camera, staged.camera_from_board[k], stripe_pixels(o.profile, rows)))
    return made


def _without(
    state: AdjustmentState, k: int, flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3], clouds: Sequence[Array]
) -> AdjustmentState | None:
    """The closed form of all frames but one; None where the others give none."""
    rest = [j for j in range(len(flanges)) if j != k]
    try:
        hand_eye = solve_hand_eye([flanges[j] for j in rest], [boards[j] for j in rest])
    except RefusedError:
        return None
    lit = [clouds[j] for j in rest if len(clouds[j])]
    plane = state.plane
    if plane is not None and lit:
        plane = robust_plane(np.concatenate(lit))[0]
    return replace(
        state, plane=plane, flange_from_camera=hand_eye.flange_from_camera, base_from_board=hand_eye.base_from_board
    )


def _step(whole: AdjustmentState, other: AdjustmentState) -> Array:
    """The step (27,) from one state to another: hand-eye, board and plane."""
    step = np.zeros(SHARED)
    step[HAND] = difference(other.flange_from_camera, whole.flange_from_camera)
    step[BOARD] = difference(other.base_from_board, whole.base_from_board)
    if whole.plane is not None and other.plane is not None:
        a, b = tangents(whole.plane.n)
        step[PLANE] = other.plane.n @ a, other.plane.n @ b, other.plane.distance - whole.plane.distance
    return step

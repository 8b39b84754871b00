"""Every view left out in turn, from the normal equations at the solution: one step each instead of one adjustment each.

Says how well the others predict a view, and by how much each parameter scatters between the calibrations that lack one
view (jackknife): a deviation that needs no model of the noise. For views that are rests of their own.

The closed form with each frame left out in turn: what the joint adjustment has to beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.solve.adjustment import Adjusted, Adjustment, Priors
from cell.measure.calibration.solve.joint import Staged, start_state
from cell.measure.calibration.solve.normal import (
    BOARD,
    CAMERA,
    FLANGE,
    HAND,
    OWN,
    PLANE,
    SHARED,
    AdjustmentState,
    ViewData,
    dots_block,
    stripe_block,
    tangents,
)
from cell.measure.calibration.solve.starts import robust_plane, solve_hand_eye, stripe_pixels
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import difference, perturbed, transform
from cell.measure.vision.stripe_on_board import on_plane
from drivers.errors import RefusedError

Mask = NDArray[np.bool_]
BEST_POSE_STEPS = 3
UNKNOWN = 1e6
LARGEST_STEP = 1.0
"""A step of a pose or the plane, in m or rad, beyond which the other views determine nothing."""
TIE = 1e-9
"""Share of the information that holds directions which the other views do not determine at all."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Of each view (n,), predicted by the others: RMS per component in px, stripe and board in m; NaN where unseen.

    `dots_px` at the view's own best pose: it judges the camera alone. `stripe_m` is the stripe's distance from the
    board's plane, `board_m` the distance of the board's points from where the others put them, at the flange pose that
    the arm reports. `squares` is the sum of the squared px. `covariance` (27, 27) is the jackknife's of the shared
    parameters. `by_held` (27, 27) says by how much each free parameter follows (rows) where a held one is wrong.
    """

    states: list[AdjustmentState]
    dots_px: Array
    stripe_m: Array
    board_m: Array
    squares: Array
    covariance: Array
    by_held: Array

    @property
    def figures(self) -> dict[str, float]:
        """Over all views: `dots_px`, `stripe_mm` and `board_mm`; NaN where nothing was seen."""
        return {
            "dots_px": _rms(self.dots_px),
            "stripe_mm": 1e3 * _rms(self.stripe_m),
            "board_mm": 1e3 * _rms(self.board_m),
        }


def leave_out(adjustment: Adjustment, adjusted: Adjusted) -> LeftOut:
    """Each view predicted by the others, at the solution `adjusted` of `adjustment`."""
    state, free = adjusted.state, np.flatnonzero(adjustment.free)
    parts = [_reduced(adjustment, k, state) for k in range(len(adjustment.views))]
    lens, off = adjustment.lens_prior(state)
    information = np.asarray(lens.T @ lens + np.sum([h for h, _ in parts], axis=0))
    gradient = np.asarray(lens.T @ off + np.sum([g for _, g in parts], axis=0))
    scale = 1 / np.sqrt(np.maximum(np.diag(information)[free], 1e-30))
    steps, states = [], []
    for h, g in parts:
        rest = (information - h)[np.ix_(free, free)] * scale[:, None] * scale + TIE * np.eye(len(free))
        step = np.zeros(SHARED)
        step[free] = scale * np.linalg.lstsq(rest, scale * (gradient - g)[free], rcond=None)[0]
        steps.append(step)
        steps[-1] = step = step if np.abs(step[CAMERA.stop :]).max() < LARGEST_STEP else np.full(SHARED, np.nan)
        far = not np.isfinite(step).all()
        states.append(state if far else state.moved(np.concatenate([step, np.zeros(OWN * len(parts))])))
    figures = np.array(
        [
            predicted(v, f, s) if np.isfinite(d).all() else [np.inf] * 4
            for v, f, s, d in zip(adjustment.views, state.flanges, states, steps, strict=True)
        ]
    )
    count = len(parts)
    apart = np.nan_to_num(np.array(steps) - np.mean(steps, axis=0), nan=np.sqrt(UNKNOWN))
    held = np.setdiff1d(np.arange(SHARED), free)
    by_held = np.zeros((SHARED, SHARED))
    inner = information[np.ix_(free, free)] * scale[:, None] * scale + TIE * np.eye(len(free))
    by_held[np.ix_(free, held)] = -scale[:, None] * np.linalg.solve(
        inner, scale[:, None] * information[np.ix_(free, held)]
    )
    dots, stripe, board, squares = figures.T
    scatter = np.asarray((count - 1) / count * apart.T @ apart)
    return LeftOut(states, dots, stripe, board_m=board, squares=squares, covariance=scatter, by_held=by_held)


def _reduced(adjustment: Adjustment, k: int, state: AdjustmentState) -> tuple[Array, Array]:
    """Information (27, 27) and gradient (27,) that a view brings for the shared parameters, its own pose eliminated."""
    rows, right = [np.zeros((0, 34))], [np.zeros(0)]
    for _, jacobian, residual, _ in adjustment.rows_of(k, state):
        rows.append(jacobian)
        right.append(residual)
    own_rows, own_right = adjustment.arm_prior(k, state)
    stacked = np.vstack([*rows, own_rows])
    measured = np.concatenate([*right, own_right])
    basis = np.linalg.qr(stacked[:, FLANGE])[0]
    shared = stacked[:, :SHARED] - basis @ (basis.T @ stacked[:, :SHARED])
    return np.asarray(shared.T @ shared), np.asarray(shared.T @ measured)


def predicted(view: ViewData, flange: pin.SE3, other: AdjustmentState) -> list[float]:
    """RMS px at the best pose, stripe and board in m at the reported pose, and the sum of squares in px².

    By a calibration that has not seen the view; `flange` is about where the view itself puts the flange.
    """
    if not np.isfinite(other.camera.parameters).all() or other.camera.fx <= 0 or other.camera.fy <= 0:
        return [np.inf, np.inf, np.inf, np.inf]
    dots, stripe, board, squares = np.nan, np.nan, np.nan, 0.0
    if len(view.points):
        for _ in range(BEST_POSE_STEPS):
            residual, jacobian = dots_block(other, view, flange, view.rail)
            rows = jacobian.reshape(-1, jacobian.shape[2])[:, FLANGE]
            step = np.linalg.lstsq(rows, residual.ravel(), rcond=None)[0]
            flange = perturbed(flange, step)
        left = dots_block(other, view, flange, view.rail)[0].ravel()
        squares = float(left @ left)
        dots = float(np.sqrt(squares / len(left)))
        # The pose at which the camera sees the board is the one that a moved flange would give.
        seen = other.camera_from_board(flange, view.rail)
        told = other.camera_from_board(view.base_from_flange, view.rail)
        board = _rms(np.linalg.norm(transform(seen, view.points) - transform(told, view.points), axis=1))
    if len(view.stripe) and other.plane is not None:
        stripe = _rms(stripe_block(other, view, view.base_from_flange, view.rail)[0])
    return [dots, stripe, board, squares]


def _rms(values: Array) -> float:
    known = np.asarray(values)[~np.isnan(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


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

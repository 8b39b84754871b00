"""From observations to the joint adjustment and its cross-checks: the common part of all calibrations with poses."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.judge.scale import BoardSize
from cell.measure.calibration.solve import normal, starts
from cell.measure.calibration.solve.adjustment import Adjusted, Adjustment, Priors, rms_of, shared_mask
from cell.measure.calibration.solve.bow import with_bow
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.poses import from_parts
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardView
from drivers.errors import RefusedError

STRIPE_POINTS = 120
"""About so many means of neighbouring rows stand for a stripe: quicker than all rows, and no less is known.

Rows that share their speckle are less independent than their stated σ says; that scale is found from the residuals.
"""
FOLDS = 4


@dataclass(frozen=True, eq=False)
class Staged:
    """The closed-form solution: camera, hand-eye, light plane (None without a stripe).

    From the first view of each rest of the arm. `plane` holds the stripe's usable rows of all observations; its plane
    is that of the paper's steps where they give one.
    """

    camera: CameraModel
    camera_from_board: list[pin.SE3]
    hand_eye: starts.HandEye
    plane: starts.PlaneStart | None


@dataclass(frozen=True, eq=False)
class Joint:
    """Staged and joint solution, the data they were made of, and how well held-out views are predicted. `free` (27,)
    says which shared parameters moved; `size` how large the arm's ways say that the board is, where that was asked."""

    staged: Staged
    adjusted: Adjusted
    views: list[normal.ViewData]
    held_out_px: float
    held_out_stripe_m: float
    free: NDArray[np.bool_]
    size: BoardSize | None = None


def solve_staged(
    observations: Sequence[ScanObservation], nominal: CameraModel | None = None, rail_direction: Array | None = None,
    stripe: bool = True, camera: CameraModel | None = None,
) -> Staged:  # fmt: skip
    """Camera, then hand-eye, then light plane, each from the result before. All observations need a view. A `camera`
    that is known already is not estimated again."""
    every, observations = observations, [o for o in observations if not o.same_rest]
    views = [o.view for o in observations if o.view is not None]
    if camera is None:
        camera = starts.zhang(views, nominal)
    poses = [board_pose(view, camera).camera_from_board for view in views]
    with_view = [o for o in observations if o.view is not None]
    hand_eye = starts.solve_hand_eye(
        [o.base_from_flange for o in with_view], poses, [o.rail_position for o in with_view], rail_direction
    )
    lit = stripe and any(o.profile is not None for o in observations)
    return Staged(camera, poses, hand_eye, _light_plane(camera, hand_eye, poses, every) if lit else None)


def _light_plane(
    camera: CameraModel, hand_eye: starts.HandEye, poses: Sequence[pin.SE3], every: Sequence[ScanObservation]
) -> starts.PlaneStart:
    """From the stripes of `every` observation, and the board's poses at those that see it; with the paper's plane."""
    observations = [o for o in every if not o.same_rest]
    seen = iter(poses)
    everywhere = [_expected(hand_eye, o) if o.view is None else next(seen) for o in observations]
    first = next(o.view for o in observations if o.view is not None)
    views, profiles = [o.view or first for o in observations], [o.profile for o in observations]
    plane = starts.plane_from_board(camera, everywhere, views, profiles)
    with suppress(RefusedError):
        paper, rms = starts.paper_plane(camera, _crossed(observations, everywhere, plane.rows))
        plane = replace(plane, plane=paper, rms=rms)
    rows, nothing = iter(plane.rows), np.empty(0, dtype=np.intp)
    return replace(plane, rows=[nothing if o.same_rest else next(rows) for o in every])


def _crossed(
    observations: Sequence[ScanObservation], poses: Sequence[pin.SE3], rows: Sequence[NDArray[np.intp]]
) -> list[tuple[pin.SE3, BoardView, Array]]:
    """Pose and view of the board, and the stripe's pixels, of the observations that show both."""
    return [
        (pose, o.view, starts.stripe_pixels(o.profile, r))
        for o, pose, r in zip(observations, poses, rows, strict=True)
        if o.view is not None and o.profile is not None and len(r)
    ]


def _expected(hand_eye: starts.HandEye, o: ScanObservation) -> pin.SE3:
    flange_from_camera = hand_eye.flange_from_camera * from_parts(o.rail_position * hand_eye.rail_direction)
    return (o.base_from_flange * flange_from_camera).inverse() * hand_eye.base_from_board


def view_data(observation: ScanObservation, rows: NDArray[np.intp]) -> normal.ViewData:
    """Measurements of one observation, the stripe as about `STRIPE_POINTS` means of neighbouring rows."""
    view, profile = observation.view, observation.profile
    stripe, sigma = np.zeros((0, 2)), np.zeros(0)
    if profile is not None and len(rows):
        stripe, sigma = starts.stripe_means(profile, rows, STRIPE_POINTS)
    return normal.ViewData(
        points=np.zeros((0, 3)) if view is None else view.object_points,
        pixels=np.zeros((0, 2)) if view is None else view.pixels, sigma=np.zeros(0) if view is None else view.sigma,
        dot_radius=0.0 if view is None else view.dot_radius, stripe=stripe, stripe_sigma=sigma,
        base_from_flange=observation.base_from_flange, rail=observation.rail_position,
        stripe_axis=1 if profile is not None and profile.axis == "columns" else 0, same_rest=observation.same_rest,
    )  # fmt: skip


def start_state(staged: Staged) -> normal.AdjustmentState:
    """The joint adjustment's start."""
    return normal.AdjustmentState(
        staged.camera, None if staged.plane is None else staged.plane.plane, staged.hand_eye.rail_direction,
        staged.hand_eye.flange_from_camera, staged.hand_eye.base_from_board,
    )  # fmt: skip


def solve_joint(
    observations: Sequence[ScanObservation], staged: Staged, priors: Priors, held_out: bool = True
) -> Joint:
    """Adjust everything together, and predict the views of every fourth rest from the others in turn."""
    rows = [np.empty(0, dtype=np.intp)] * len(observations) if staged.plane is None else staged.plane.rows
    views = [view_data(o, r) for o, r in zip(observations, rows, strict=True)]
    rail = float(np.ptp([o.rail_position for o in observations])) > 1e-3
    free = shared_mask(plane=staged.plane is not None, rail=rail)
    problem = Adjustment(views, free, priors)
    adjusted = with_bow(problem, problem.solve(start_state(staged)))
    px, stripe = float("nan"), float("nan")
    if held_out and len(views) > FOLDS:
        px, stripe = _held_out(views, free, adjusted)
    return Joint(staged, adjusted, views, held_out_px=px, held_out_stripe_m=stripe, free=free)


def _held_out(views: list[normal.ViewData], free: NDArray[np.bool_], adjusted: Adjusted) -> tuple[float, float]:
    """RMS in px and m of the views of the rests that each fold leaves out, at the flange poses that the arm reports."""
    dots, stripe = [np.zeros(0)], [np.zeros(0)]
    folds = normal.rests_of(views) % FOLDS
    for fold in range(FOLDS):
        kept = [v for v, of in zip(views, folds, strict=True) if of != fold]
        result = Adjustment(kept, free, adjusted.priors).solve(adjusted.state, variance_rounds=0, settled=1e-3)
        for view in (v for v, of in zip(views, folds, strict=True) if of == fold):
            off, away = residuals_as_reported(result.state, view)
            dots.append(off.ravel())
            stripe.append(away)
    return rms_of(np.concatenate(dots)), rms_of(np.concatenate(stripe))


def residuals_as_reported(state: normal.AdjustmentState, view: normal.ViewData) -> tuple[Array, Array]:
    """Residuals of the dots (n, 2) in px and of the stripe (m,) in m at the flange pose that the arm reports."""
    off, away = np.zeros((0, 2)), np.zeros(0)
    if len(view.points):
        off = normal.dots_block(state, view, view.base_from_flange, view.rail)[0]
    if len(view.stripe) and state.plane is not None:
        away = normal.stripe_block(state, view, view.base_from_flange, view.rail)[0]
    return off, away


def effective_hand_eye_covariance(joint: Joint) -> Array:
    """6×6 covariance of flange_from_camera as it counts for a board's pose in the flange.

    The camera's parameters and the hand-eye are known together much better than apart (a shift of the principal point
    looks like a turn of the camera): what remains, when a board is seen through both, is given here as if it were the
    hand-eye's alone, as the mean over the calibration's views.
    """
    state, covariance = joint.adjusted.state, joint.adjusted.reliable_covariance
    both = np.r_[np.arange(normal.CAMERA.start, normal.CAMERA.stop), np.arange(normal.HAND.start, normal.HAND.stop)]
    known = covariance[np.ix_(both, both)]
    parts = []
    for view, flange, rail in zip(joint.views, state.flanges, state.rails, strict=True):
        if len(view.points) < 6:
            continue
        jacobian = normal.dots_block(state, view, flange, float(rail))[1].reshape(-1, normal.COLUMNS)
        # A move of the hand-eye moves all pixels as a move of the board in the camera would: the picture's six
        # degrees of freedom, in the hand-eye's own terms.
        by_hand, by_camera = jacobian[:, normal.HAND], jacobian[:, normal.CAMERA]
        absorbed = np.linalg.lstsq(by_hand, by_camera, rcond=None)[0]
        to_hand = np.hstack([absorbed, np.eye(6)])
        parts.append(to_hand @ known @ to_hand.T)
    if not parts:
        return np.asarray(covariance[normal.HAND, normal.HAND], dtype=np.float64)
    mean = np.mean(parts, axis=0)
    return np.asarray(0.5 * (mean + mean.T), dtype=np.float64)

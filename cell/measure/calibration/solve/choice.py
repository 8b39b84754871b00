"""Which solution of a chain with flange poses is kept: the one that predicts frames that were left out best.

The camera may stay what the pictures say or be adjusted with the arm, the arm may be trusted as much as its residuals
say or more, the stripe's points may count all or a tenth; the closed form stands beside them. A camera that the arm has
bent does not fit left-out pictures at their own best pose as well as before, and is not kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.solve.adjustment import (
    Adjusted,
    Adjustment,
    LeftOut,
    Mask,
    Priors,
    leave_out,
    predicted,
    shared_mask,
)
from cell.measure.calibration.solve.intrinsics import Intrinsics
from cell.measure.calibration.solve.joint import Staged, start_state, view_data
from cell.measure.calibration.solve.normal import (
    BOARD,
    CAMERA,
    HAND,
    PLANE,
    SHARED,
    AdjustmentState,
    ViewData,
    tangents,
)
from cell.measure.calibration.solve.starts import robust_plane, solve_hand_eye, stripe_pixels
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import difference
from cell.measure.vision.stripe_on_board import on_plane
from drivers.errors import RefusedError

TRUSTS = (1.0, 0.3, 0.1)
"""Shares of the arm's estimated scatter that are tried as its weight: much of that is the pictures' own."""
GOOD_ARM = (3e-5, 6e-5)
FEWER_POINTS = 0.1
ROUNDS, ARM_ROUNDS = 3, 15
LEAST_LIT = 4
WORTH_MOVING = 0.95
"""An adjusted camera has to predict left-out frames better than that of the pictures, by this share."""
BENT_SHARE, BENT_SIGMAS = 1.02, 3.0
"""How much worse left-out pictures may fit an adjusted camera, and how far it may go from the pictures' own."""
ARM_RANGE, TURN_RANGE = (1e-5, 1e-2), (2e-5, 5e-2)


@dataclass(frozen=True, eq=False)
class Solution:
    """A solution, what it was made of, and how it predicts left-out frames.

    `pictures` is the camera's covariance (9, 9) from the pictures alone: where the camera is held, everything else
    follows its error. `unsure` (27,) are deviations of what other checks found, such as a scale that disagrees.
    """

    name: str
    adjusted: Adjusted
    views: list[ViewData]
    free: Mask
    left: LeftOut
    pictures: Array
    joint: bool = True
    camera_free: bool = False
    unsure: Array = field(default_factory=lambda: np.zeros(SHARED))

    def figure(self) -> float:
        """What is compared, in mm, of left-out frames at the reported flange poses.

        How far the board lies from where the others put it; with enough stripes the geometric mean of that and of the
        stripe's distance from the board.
        """
        figures = self.left.figures
        lit = int(np.isfinite(self.left.stripe_m).sum()) >= LEAST_LIT
        return float(np.sqrt(figures["stripe_mm"] * figures["board_mm"])) if lit else figures["board_mm"]

    @property
    def formal(self) -> Array:
        """Deviations (27,) as the residuals say them."""
        return np.sqrt(np.maximum(np.diag(self.adjusted.reliable_covariance) + self._by_camera(), 0.0))

    @property
    def scatter(self) -> Array:
        """Deviations (27,) as the solutions that lack one frame scatter (jackknife)."""
        return np.sqrt(np.maximum(np.diag(self.left.covariance) + self._by_camera(), 0.0))

    @property
    def sigma(self) -> Array:
        """Deviations (27,) that are stated: the larger of both."""
        return np.hypot(np.maximum(self.formal, self.scatter), self.unsure)

    def _by_camera(self) -> Array:
        """Variances (27,) that a held camera's error leaves."""
        follow = self.left.by_held[:, CAMERA]
        return np.asarray(np.einsum("ij,jk,ik->i", follow, self.pictures, follow))


@dataclass(frozen=True, eq=False)
class Choice:
    """The solution that is kept, the closed form, all that were tried, and the arm's scatter per axis (m, rad)."""

    best: Solution
    closed: Solution
    tried: list[Solution]
    arm: tuple[float, float]

    @property
    def with_arm(self) -> Solution | None:
        """The best of those whose camera was adjusted with the arm; None where none was tried."""
        adjusted = [s for s in self.tried if s.camera_free]
        return self.best if self.best.camera_free else min(adjusted, key=lambda s: s.figure(), default=None)


def choose_solution(
    observations: Sequence[ScanObservation], staged: Staged, pictures: Intrinsics, camera_may_move: bool = True
) -> Choice:
    """The solution that predicts left-out frames best; `staged` was made with the camera of `pictures`."""
    rows = [np.empty(0, dtype=np.intp)] * len(observations) if staged.plane is None else staged.plane.rows
    views = [view_data(o, r) for o, r in zip(observations, rows, strict=True)]
    held = shared_mask(plane=staged.plane is not None, rail=False)
    held[CAMERA] = False
    moving = held.copy()
    moving[CAMERA] = pictures.model.free
    arm = _arm_scatter(views, held, staged)

    def solved(weight: tuple[float, float], share: float, camera_free: bool) -> Solution:
        priors = Priors(*weight, stripe_share=share)
        free = moving if camera_free else held
        adjustment = Adjustment(views, free, pictures.model.priors(priors))
        adjusted = adjustment.solve(start_state(staged), ROUNDS)
        name = f"joint adjustment, camera {'adjusted with the arm' if camera_free else 'as the pictures say'}"
        left = leave_out(adjustment, adjusted)
        return Solution(
            name, adjusted, views, free, left=left, pictures=pictures.covariance, joint=True, camera_free=camera_free
        )

    plain, plain_left = closed_form(observations, staged, views, held)
    weights = [(float(np.clip(t * arm[0], *ARM_RANGE)), float(np.clip(t * arm[1], *TURN_RANGE))) for t in TRUSTS]
    if arm[0] > 2 * GOOD_ARM[0]:
        weights.append(GOOD_ARM)
    first = [solved(weight, 1.0, False) for weight in weights]
    tried = list(first)
    best = int(np.argmin([_or_last(s) for s in first]))
    shares = (1.0, FEWER_POINTS) if staged.plane is not None else (1.0,)
    tried += [solved(weights[best], share, False) for share in shares[1:]]
    if camera_may_move:
        tried += [solved(weights[best], share, True) for share in shares]
    # All follow the camera in the same way, the closed form too.
    follow = replace(plain_left, by_held=first[best].left.by_held)
    closed = Solution(
        "closed form (Park-Martin)", plain, views, held, left=follow, pictures=pictures.covariance, joint=False
    )
    sound = [closed, *(s for s in tried if not _bent(s, pictures))]
    chosen = min(sound, key=lambda s: _or_last(s) / (WORTH_MOVING if s.camera_free else 1.0))
    return Choice(chosen, closed, [closed, *tried], arm)


def with_doubt_of_camera(choice: Choice, pictures: Intrinsics) -> tuple[Choice, Intrinsics]:
    """The same where the pictures' camera is kept and the arm clearly says another one: with a deviation for that.

    Which of both is right is not known; half of what parts them is added to the camera's deviation, and everything
    else follows.
    """
    other = choice.with_arm
    if other is None or choice.best.camera_free:
        return choice, pictures
    apart = other.adjusted.state.camera.parameters - pictures.camera.parameters
    # Both follow the same pictures: the larger deviation is what they may differ by.
    if not np.any(np.abs(apart[:4]) > BENT_SIGMAS * np.maximum(pictures.sigma[:4], other.sigma[CAMERA][:4])):
        return choice, pictures
    covariance = pictures.covariance + 0.25 * np.outer(apart, apart)
    doubted = replace(pictures, covariance=covariance, sigma=np.hypot(pictures.sigma, 0.5 * apart))
    best, closed = (replace(s, pictures=covariance) for s in (choice.best, choice.closed))
    return replace(choice, best=best, closed=closed), doubted


def _or_last(solution: Solution) -> float:
    figure = solution.figure()
    return figure if np.isfinite(figure) else np.inf


def _bent(solution: Solution, pictures: Intrinsics) -> bool:
    """True when the arm has bent the camera: left-out pictures fit it worse, or it left the pictures' own range."""
    if not solution.camera_free:
        return False
    apart = np.abs(solution.adjusted.state.camera.parameters - pictures.camera.parameters)[:4]
    if np.any(apart > BENT_SIGMAS * pictures.sigma[:4]):
        return True
    return not solution.left.figures["dots_px"] <= BENT_SHARE * pictures.held_out_px


def _arm_scatter(views: Sequence[ViewData], held: Mask, staged: Staged) -> tuple[float, float]:
    """The arm's scatter (m, rad) per axis by variance components, with the pictures' camera and without the stripe.
    What the pictures' own poses scatter is part of it: it cannot be told apart."""
    dark = [replace(v, stripe=np.zeros((0, 2)), stripe_sigma=np.zeros(0)) for v in views]
    free = held.copy()
    free[PLANE] = False
    start = Priors(
        max(staged.hand_eye.scatter_m / np.sqrt(3), ARM_RANGE[0]),
        max(staged.hand_eye.scatter_rad / np.sqrt(3), TURN_RANGE[0]), estimate_arm=True,
    )  # fmt: skip
    found = Adjustment(dark, free, start).solve(replace(start_state(staged), plane=None), ARM_ROUNDS).priors
    return found.arm_translation, found.arm_rotation


def closed_form(
    observations: Sequence[ScanObservation], staged: Staged, views: list[ViewData], free: Mask
) -> tuple[Adjusted, LeftOut]:
    """Hand-eye and light plane of all frames, as an adjustment would return them, and of all but one."""
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
    return Adjusted(state, nothing, float("nan"), dots, stripe, priors=Priors()), left


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

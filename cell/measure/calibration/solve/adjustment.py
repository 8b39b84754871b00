"""The joint adjustment: camera, light plane, rail, hand-eye and board in one robust least-squares problem.

The arm's poses and the rail's readings are unknowns too, held by their repeatability; groups of measurements whose
noise is not known get it from their own residuals (variance components). Views between which only the rail moved share
the flange's pose, wherever that was. docs/explanation/theory.md, section 6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.calibration.solve.normal import (
    CAMERA,
    COLUMNS,
    FLANGE,
    OWN,
    PLANE,
    RAIL,
    SHARED,
    AdjustmentState,
    Block,
    Inverse,
    Normal,
    ViewData,
    dots_block,
    rests_of,
    stripe_block,
)
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import difference, perturbed, transform

if TYPE_CHECKING:
    from cell.measure.calibration.solve.bow import Bow

DISTORTION_PRIOR = (0.5, 2.0, 0.01, 0.01, 2.0)
FOCAL_TIE_PX = 1e-3
# What a recorded arm may repeat to, m and rad.
ARM_RANGE, ARM_TURN_RANGE = (1e-6, 1e-2), (1e-6, 5e-2)
HUBER = 2.5
# Mean robust cost of a Gaussian residual, per component, for the dots' two components together and the stripe's one.
_OVER, _DENSITY = math.erfc(HUBER / math.sqrt(2)), math.exp(-(HUBER**2) / 2)
HUBER_COST = {
    "dots": 1 - _DENSITY + HUBER * math.sqrt(math.pi / 2) * _OVER,
    "stripe": 1 - _OVER + HUBER * _DENSITY * math.sqrt(2 / math.pi) - HUBER**2 * _OVER,
}
STEPS = 25
VARIANCE_ROUNDS = 4
# Measurements without any noise would leave the priors no digits.
LEAST_SCALE = 0.1


@dataclass(frozen=True)
class Priors:
    """What is known beforehand: one standard deviation each.

    `arm_translation` (m) and `arm_rotation` (rad) per axis of a reported flange pose, `rail` (m) of a rail reading.
    With `estimate_arm` the first two are starting values only and the residuals decide. `dots_scale` multiplies the
    σ of the dots, `stripe_scale` that of the stripe; the residuals always decide on these. Of the
    stripe's points `stripe_share` count, as if the others repeated them. `lens` are the deviations of
    k1, k2, p1, p2, k3 from 0; with `one_focal` fx is fy.
    """

    arm_translation: float = 3e-5
    arm_rotation: float = 6e-5
    rail: float = 2e-5
    estimate_arm: bool = False
    dots_scale: float = 2.0
    stripe_scale: float = 1.0
    stripe_share: float = 1.0
    lens: tuple[float, float, float, float, float] = DISTORTION_PRIOR
    one_focal: bool = False


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Result: the state, the covariance (27, 27) of the shared parameters, χ² per degree of freedom, found noise.

    The covariance is for the noise in `priors`; `reliable_covariance` allows for the scatter that was found.
    `excess` says by how much the flange's shifts and turns and the rail's readings scatter more than the priors say
    ("shift", "turn", "rail": found over stated standard deviation; 1 where nothing was found). `bow` is the light
    sheet's, where one was found.
    """

    state: AdjustmentState
    covariance: Array
    chi2_per_dof: float
    dots_rms_px: float
    stripe_rms_m: float
    priors: Priors
    excess: dict[str, float] = field(default_factory=dict)
    bow: Bow | None = None

    @property
    def inflation(self) -> float:
        """Factor of all deviations for a flange that scatters more than the priors say; it makes most of them."""
        return max(1.0, self.excess.get("shift", 1.0), self.excess.get("turn", 1.0))

    @property
    def reliable_covariance(self) -> Array:
        """The covariance (27, 27) with this factor."""
        return self.covariance * self.inflation**2


class Adjustment:
    """One problem: views, what is free, and the priors. `solve` iterates from a start."""

    def __init__(self, views: Sequence[ViewData], free: NDArray[np.bool_], priors: Priors) -> None:
        """`free` (27,) says which shared parameters move, in the order of `blocks`."""
        self.views = list(views)
        self.rests = rests_of(self.views)
        self.free = free
        self.own_free = np.ones(OWN, dtype=np.bool_)
        self.own_free[6] = bool(free[RAIL].any())
        self.priors = priors

    def solve(self, start: AdjustmentState, variance_rounds: int = VARIANCE_ROUNDS, settled: float = 1e-9) -> Adjusted:
        """Levenberg–Marquardt, then variance components, alternating until the noise agrees with the residuals. At the
        end a step that promises less than the share `settled` of the cost is not taken any more."""
        state = replace(
            start, flanges=[v.base_from_flange for v in self.views], rails=np.array([v.rail for v in self.views])
        )
        normal = self.normal_at(state)
        for turn in range(variance_rounds + 1):
            # Until the noise is settled there is no point in the last digits.
            state, normal = self._minimise(state, normal, 1e-3 if turn < variance_rounds else settled)
            if turn < variance_rounds:
                self._update_noise(normal)
                normal = self.normal_at(state)
        inverse = normal.inverse()
        expected = sum(expected_cost(name, block, inverse) for name, block in normal.groups.items())
        return Adjusted(
            state, inverse.shared, normal.total / expected, *self.residual_rms(state), self.priors,
            {name: _scatter(normal, inverse, name) for name in ("shift", "turn", "rail")},
        )  # fmt: skip

    def residual_rms(self, state: AdjustmentState) -> tuple[float, float]:
        """RMS of the dots in px (per component) and of the stripe's distances from the board in m; NaN when unseen."""
        dots, stripe = [np.zeros(0)], [np.zeros(0)]
        for view, flange, rail in zip(self.views, state.flanges, state.rails, strict=True):
            if len(view.points):
                dots.append(dots_block(state, view, flange, float(rail))[0].ravel())
            if len(view.stripe) and state.plane is not None:
                stripe.append(stripe_block(state, view, flange, float(rail))[0])
        return rms_of(np.concatenate(dots)), rms_of(np.concatenate(stripe))

    def _minimise(self, state: AdjustmentState, normal: Normal, settled: float) -> tuple[AdjustmentState, Normal]:
        damping = 1e-6
        for _ in range(STEPS):
            step = normal.step(damping)
            # A minimum that is reached promises nothing; trying on would only meet the last digits' noise.
            if normal.promised(step) < settled * normal.total + 1e-9:
                break
            if not np.isfinite(step).all():
                break
            candidate = state.moved(step)
            new = self.normal_at(candidate)
            if np.isfinite(new.total) and new.total <= normal.total * (1 + 1e-12):
                state, normal = candidate, new
                damping = max(1e-9, 0.1 * damping)
            else:
                damping *= 20
                if damping > 1e4:
                    break
        return state, normal

    def rows_of(self, k: int, state: AdjustmentState) -> list[tuple[str, Array, Array, float]]:
        """Of view `k`: group, whitened rows (m, 34) and residuals (m,), robust weights included, and robust cost."""
        view, flange, rail = self.views[k], state.flanges[k], float(state.rails[k])
        made = []
        if len(view.points):
            residual, jacobian = dots_block(state, view, flange, rail)
            sigma = self.priors.dots_scale * view.sigma
            weight, cost = huber(np.linalg.norm(residual / sigma[:, None], axis=1))
            root = (np.sqrt(weight) / sigma)[:, None]
            rows = (jacobian * root[:, :, None]).reshape(-1, COLUMNS)
            made.append(("dots", rows, np.asarray((residual * root).ravel()), cost))
        if len(view.stripe) and state.plane is not None:
            away, jacobian, sigma = stripe_block(state, view, flange, rail)
            sigma = self.priors.stripe_scale * sigma
            weight, cost = huber(np.abs(away / sigma))
            root = np.sqrt(self.priors.stripe_share * weight) / sigma
            cost *= self.priors.stripe_share
            made.append(("stripe", jacobian * root[:, None], np.asarray(away * root), cost))
        return made

    def normal_at(self, state: AdjustmentState) -> Normal:
        """The normal equations at a state whose flanges and rails are those of the views, with the present priors."""
        normal = Normal(self.rests, self.free, self.own_free)
        settles = np.diff(self.rests, prepend=-1) > 0
        for k, (view, rail) in enumerate(zip(self.views, state.rails.tolist(), strict=True)):
            for name, rows, residual, cost in self.rows_of(k, state):
                share = self.priors.stripe_share if name == "stripe" else 1.0
                normal.add_view(name, k, rows, residual=residual, cost=cost, share=share)
            if settles[k]:
                white = self.arm_prior(k, state)[1]
                normal.add_prior("shift", k, 0, white[:3], self.priors.arm_translation)
                normal.add_prior("turn", k, 3, white[3:], self.priors.arm_rotation)
            if self.own_free[6]:
                normal.add_prior("rail", k, 6, np.array([view.rail - rail]) / self.priors.rail, self.priors.rail)
        normal.add_shared_rows("lens", *self.lens_prior(state))
        return normal

    def lens_prior(self, state: AdjustmentState) -> tuple[Array, Array]:
        """Whitened rows (m, 27) and residuals (m,) of what is known of any lens, for the terms that are free."""
        lens = np.arange(4, 9)[self.free[4:9]]
        rows = np.zeros((len(lens), SHARED))
        rows[np.arange(len(lens)), lens] = 1 / np.array(self.priors.lens)[lens - 4]
        camera = state.camera.parameters
        residual = -rows[:, :9] @ camera
        if self.priors.one_focal and self.free[:2].all():
            tie = np.zeros((1, SHARED))
            tie[0, 0], tie[0, 1] = 1 / FOCAL_TIE_PX, -1 / FOCAL_TIE_PX
            rows, residual = np.vstack([rows, tie]), np.append(residual, -tie[0, :9] @ camera)
        return rows, residual

    def arm_prior(self, k: int, state: AdjustmentState) -> tuple[Array, Array]:
        """Whitened rows (6, 34) and residuals (6,) of the reported flange pose of view `k`."""
        apart = -difference(state.flanges[k], self.views[k].base_from_flange)
        rows = np.zeros((6, COLUMNS))
        weight = 1 / np.repeat([self.priors.arm_translation, self.priors.arm_rotation], 3)
        rows[np.arange(6), np.arange(FLANGE.start, FLANGE.stop)] = weight
        return rows, np.asarray(apart * weight)

    def _update_noise(self, normal: Normal) -> None:
        """Scale each group's σ so that its χ² meets its redundancy."""
        inverse = normal.inverse()
        factors = {}
        for name in ["dots", "stripe"] + (["shift", "turn"] if self.priors.estimate_arm else []):
            if normal.groups[name].count:
                factors[name] = _scatter(normal, inverse, name)
        p = self.priors
        self.priors = replace(
            p, dots_scale=max(p.dots_scale * factors.get("dots", 1.0), LEAST_SCALE),
            stripe_scale=max(p.stripe_scale * factors.get("stripe", 1.0), LEAST_SCALE),
            arm_translation=float(np.clip(p.arm_translation * factors.get("shift", 1.0), *ARM_RANGE)),
            arm_rotation=float(np.clip(p.arm_rotation * factors.get("turn", 1.0), *ARM_TURN_RANGE)),
        )  # fmt: skip


def _scatter(normal: Normal, inverse: Inverse, name: str) -> float:
    """Found over assumed standard deviation of a group: the root of its cost over the expected; 1 for an empty one."""
    block = normal.groups[name]
    if block.count == 0:
        return 1.0
    return float(np.clip(np.sqrt(block.squares / expected_cost(name, block, inverse)), 0.1, 10.0))


def shared_mask(*, plane: bool, rail: bool) -> NDArray[np.bool_]:
    """Which of the 27 shared parameters move: always fx … k1, hand-eye and board; k3 never (it is not observable)."""
    free = np.ones(SHARED, dtype=np.bool_)
    free[CAMERA.start + 8] = False
    free[PLANE] = plane
    free[RAIL] = rail
    return free


def expected_cost(name: str, block: Block, inverse: Inverse) -> float:
    """What a group's robust cost is on average, when its noise is Gaussian and as large as assumed."""
    return max(block.count - inverse.taken(block), 0.02 * block.count) * HUBER_COST.get(name, 1.0)


def huber(size: Array) -> tuple[Array, float]:
    """Weights (n,) and cost of whitened residual lengths (n,)."""
    weight = np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
    cost = np.where(size <= HUBER, size**2, 2 * HUBER * size - HUBER**2)
    return weight, float(cost.sum())


def rms_of(values: Array) -> float:
    """NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


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
            "dots_px": _rms_of_known(self.dots_px),
            "stripe_mm": 1e3 * _rms_of_known(self.stripe_m),
            "board_mm": 1e3 * _rms_of_known(self.board_m),
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
    """RMS px at the best pose, stripe and board in m at the reported pose, and the sum of squares in px². By a
    calibration that has not seen the view; `flange` is about where the view itself puts the flange."""
    if not np.isfinite(other.camera.parameters).all() or other.camera.fx <= 0 or other.camera.fy <= 0:
        return [np.inf, np.inf, np.inf, np.inf]
    dots, stripe, board, squares = np.nan, np.nan, np.nan, 0.0
    if len(view.points):
        for _ in range(BEST_POSE_STEPS):
            residual, jacobian = dots_block(other, view, flange, view.rail)
            rows = jacobian.reshape(-1, jacobian.shape[2])[:, FLANGE]
            flange = perturbed(flange, np.linalg.lstsq(rows, residual.ravel(), rcond=None)[0])
        left = dots_block(other, view, flange, view.rail)[0].ravel()
        squares = float(left @ left)
        dots = float(np.sqrt(squares / len(left)))
        # The pose at which the camera sees the board is the one that a moved flange would give.
        seen = other.camera_from_board(flange, view.rail)
        told = other.camera_from_board(view.base_from_flange, view.rail)
        board = _rms_of_known(np.linalg.norm(transform(seen, view.points) - transform(told, view.points), axis=1))
    if len(view.stripe) and other.plane is not None:
        stripe = _rms_of_known(stripe_block(other, view, view.base_from_flange, view.rail)[0])
    return [dots, stripe, board, squares]


def _rms_of_known(values: Array) -> float:
    known = np.asarray(values)[~np.isnan(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

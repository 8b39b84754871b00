"""A camera from pictures of a board alone: dots as circles, the lens as needed, and whether the board is bent.

Which terms of the lens are free is decided on views that were left out: a few pictures of a small board fit any lens.
A bent board moves focal length and principal point by many times their formal deviation, and leaves small residuals.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.calibration.solve.adjustment import DISTORTION_PRIOR, Adjustment, LeftOut, Priors, leave_out
from cell.measure.calibration.solve.normal import CAMERA, FLANGE, SHARED, AdjustmentState, ViewData
from cell.measure.calibration.solve.starts import zhang
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardView
from drivers.errors import RefusedError

# Poses that nothing is known of: each picture's own.
UNKNOWN = Priors(arm_translation=10.0, arm_rotation=10.0)
LEAST_LEFT_OUT = 4
"""Views below which leaving one out says nothing."""
TANGENTIAL_VIEWS = 12
ROUNDS = 3
# A term beyond the first ones has to predict left-out views better by this share, and by this many of its deviations.
CLEARLY_BETTER, CLEAR_DEVIATIONS = 0.005, 1.0
AS_GOOD = 1.02
"""A lens predicts left-out views as well as another one up to this ratio."""
CENTRED_LENS = 0.002
"""Deviation of p1 and p2 of a lens that nothing is known of; the makers centre their lenses."""


@dataclass(frozen=True)
class LensModel:
    """Which of k1, k2, p1 and p2, k3 are free, and whether fx and fy are one; what is not free is 0, or as `given`."""

    name: str
    k1: bool = False
    k2: bool = False
    tangential: bool = False
    k3: bool = False
    one_focal: bool = False
    given: bool = False

    @property
    def free(self) -> list[bool]:
        """Of the nine parameters of a camera, in the order of `PARAMETER_NAMES`."""
        return [True] * 4 + [self.k1, self.k2, self.tangential, self.tangential, self.k3]

    def priors(self, priors: Priors) -> Priors:
        """The priors with what is known of such a lens."""
        k1, k2, _, _, k3 = DISTORTION_PRIOR
        return replace(priors, lens=(k1, k2, CENTRED_LENS, CENTRED_LENS, k3), one_focal=self.one_focal)

    def held(self, camera: CameraModel) -> CameraModel:
        """The camera with the terms that are not free at 0, or as they were given."""
        return camera if self.given else camera.with_parameters(np.where(self.free, camera.parameters, 0.0))


PLAIN = LensModel("no distortion")
GIVEN = LensModel("given", given=True)
RADIAL = (LensModel("k1", k1=True), LensModel("k1, k2", k1=True, k2=True))
FURTHER = (("k3", {"k1": True, "k2": True, "k3": True}), ("tangential", {"tangential": True}))


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A camera, RMS per component in px: of each view (n,), of all, and of left-out views (NaN with too few).

    `sigma` (9,) is the larger of what the residuals say and of the scatter between calibrations that lack one view.
    `formal` (9,) the former alone. `tried` has the RMS of left-out views of each lens model that was tried.
    `bend` is how far the board seems to be bent; what it would move the camera is in the deviations, and where it is
    not believed, what a usual bend would that the views do not exclude. `pull` (n,) is how far each view moves focal
    lengths and principal point, over what the residuals allow (Cook's distance); empty with too few views.
    """

    camera: CameraModel
    view_rms: Array
    rms_px: float
    held_out_px: float
    sigma: Array
    formal: Array = field(default_factory=lambda: np.zeros(9))
    covariance: Array = field(default_factory=lambda: np.zeros((9, 9)))
    model: LensModel = PLAIN
    tried: dict[str, float] = field(default_factory=dict)
    bend: "Bend | None" = None
    pull: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class _LensFit:
    model: LensModel
    camera: CameraModel
    covariance: Array
    left: LeftOut | None
    bend: "Bend | None"
    untold: Array = field(default_factory=lambda: np.zeros((0, 9)))
    """What a bend that is not believed may have moved the camera (n, 9)."""

    @property
    def held_out(self) -> float:
        return float("nan") if self.left is None else self.left.figures["dots_px"]


def choose_lens(views: Sequence[BoardView]) -> tuple[Intrinsics, Intrinsics]:
    """The camera with the lens model that the views support, and the one without distortion. Raises RefusedError."""
    start = zhang(views, lens=False)
    plain = _fitted(PLAIN, start, data_of(views, start))
    if len(views) < LEAST_LEFT_OUT:
        # Too few to choose a lens: what one with distortion would say is not known better.
        try:
            other = _fitted(RADIAL[0], start, data_of(views, start)).camera
        except (RefusedError, np.linalg.LinAlgError):
            other = None
        found = _intrinsics(plain, views, {}, other)
        return found, found
    fits = [plain]
    try:
        curved = zhang(views)
        data = data_of(views, curved)
        fits += [_fitted(model, curved, data) for model in RADIAL]
    except RefusedError:
        curved, data = start, data_of(views, start)
    best = min(fits, key=lambda fit: fit.held_out)
    for name, terms in FURTHER:
        if name == "tangential" and len(views) < TANGENTIAL_VIEWS:
            continue
        more = _fitted(replace(best.model, name=f"{best.model.name}, {name}", **terms), curved, data)
        fits.append(more)
        if _clearly_better(more, best):
            best = more
    one = _fitted(replace(best.model, name=f"{best.model.name}, fx = fy", one_focal=True), best.camera, data)
    fits.append(one)
    if one.held_out <= best.held_out:
        best = one
    tried = {fit.model.name: float(np.sqrt(2)) * fit.held_out for fit in fits}
    other = None
    if len(views) < TANGENTIAL_VIEWS:
        # A lens that is off its axis cannot be told from a few views, nor that it is not: what it moves is not known.
        tilted = _fitted(replace(best.model, tangential=True), best.camera, data)
        if tilted.held_out <= AS_GOOD * best.held_out:
            other = tilted.camera
    return _intrinsics(best, views, tried, other), _intrinsics(plain, views, tried)


def given_camera(camera: CameraModel, views: Sequence[BoardView]) -> Intrinsics:
    """A camera that is known, with the views' residuals in it; its own deviation is not known here. Raises RefusedError
    without views."""
    if not views:
        raise RefusedError("no picture shows the board, and a given camera needs one to be used: see why, by picture")
    rms = np.array([board_pose(view, camera).rms_px for view in views])
    return Intrinsics(camera, rms, _mean(rms, views), _mean(rms, views), np.zeros(9), model=GIVEN)


def beside_given(camera: CameraModel, views: Sequence[BoardView]) -> Intrinsics:
    """Focal lengths and principal point that the views give by themselves, with the lens of a camera that is known."""
    return _intrinsics(_fitted(GIVEN, camera, data_of(views, camera)), views, {})


def _clearly_better(more: _LensFit, less: _LensFit) -> bool:
    """True when a richer lens predicts the left-out views better, by more than a view or two may do by chance."""
    if more.left is None or less.left is None or not more.held_out < (1 - CLEARLY_BETTER) * less.held_out:
        return False
    gain = less.left.squares - more.left.squares
    return bool(gain.sum() > CLEAR_DEVIATIONS * np.sqrt(len(gain)) * gain.std(ddof=1))


def adjustment_of(model: LensModel, start: CameraModel, data: list[ViewData]) -> tuple[Adjustment, AdjustmentState]:
    """The adjustment of a camera with such a lens and of each view's pose, and where it starts."""
    free = np.zeros(SHARED, dtype=np.bool_)
    free[CAMERA] = model.free
    at = AdjustmentState(model.held(start), None, np.zeros(3), pin.SE3.Identity(), pin.SE3.Identity())
    return Adjustment(data, free, model.priors(UNKNOWN)), at


def _fitted(model: LensModel, start: CameraModel, data: list[ViewData]) -> _LensFit:
    adjustment, at = adjustment_of(model, start, data)
    result = adjustment.solve(at, ROUNDS)
    left = leave_out(adjustment, result) if len(data) >= LEAST_LEFT_OUT else None
    bend = bend_of(adjustment, result.state) if left is not None else None
    found = _LensFit(model, result.state.camera, result.covariance[CAMERA, CAMERA], left, bend)
    if bend is not None and bend.believed:
        return found
    return replace(found, untold=untold_by_bend(adjustment, result.state))


def _intrinsics(
    fit: _LensFit, views: Sequence[BoardView], tried: dict[str, float], other: CameraModel | None = None
) -> Intrinsics:
    """`other` is a camera that explains the views as well: how far it is away is not known better."""
    rms = np.array([board_pose(view, fit.camera).rms_px for view in views])
    formal = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    covariance = fit.covariance
    if fit.left is not None:
        scattered = fit.left.covariance[CAMERA, CAMERA]
        if np.any(np.diag(scattered)[:4] > formal[:4] ** 2):
            covariance = fit.covariance + scattered
    for moved in (
        None if fit.bend is None or not fit.bend.believed else fit.bend.camera,
        None if other is None else other.parameters - fit.camera.parameters,
        *fit.untold,
    ):
        if moved is not None:
            covariance = covariance + np.outer(moved, moved)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Intrinsics(
        fit.camera, rms, _mean(rms, views), held_out_px=fit.held_out, sigma=sigma, formal=formal,
        covariance=covariance, model=fit.model, tried=tried, bend=fit.bend,
        pull=np.zeros(0) if fit.left is None else _pull(fit.camera, fit.left, fit.covariance),
    )  # fmt: skip


def _pull(camera: CameraModel, left: LeftOut, covariance: Array) -> Array:
    """Cook's distance (n,) of each view in focal lengths and principal point."""
    apart = np.array([other.camera.parameters[:4] - camera.parameters[:4] for other in left.states])
    return np.asarray(np.einsum("ni,ij,nj->n", apart, np.linalg.pinv(covariance[:4, :4]), apart) / 4)


def data_of(views: Sequence[BoardView], camera: CameraModel) -> list[ViewData]:
    """The views for an adjustment, each with the board's pose in the camera for its flange."""
    poses = [board_pose(view, camera).camera_from_board.inverse() for view in views]
    return [
        ViewData(v.object_points, v.pixels, v.sigma, dot_radius=v.dot_radius, base_from_flange=pose)
        for v, pose in zip(views, poses, strict=True)
    ]


def _mean(rms: Array, views: Sequence[BoardView]) -> float:
    return float(np.sqrt(np.average(rms**2, weights=[len(v.ids) for v in views])))


SHAPES = 3
SIGNIFICANT, CERTAIN = 4.0, 2.0
"""Deviations, by leaving views out, from which a bend is believed."""
USUAL = 1.5e-3
"""Share of its diagonal by which a board may be bent without a doubt."""
LEAST_RISE = 1e-6


@dataclass(frozen=True, eq=False)
class Bend:
    """How far in m the board's points stand out of a plane, its deviation, and what the camera's parameters (9,) would
    move if that were taken into account. `share` is the bend over the board's diagonal,
    `certain` by how many of its deviations left-out views are predicted better with it."""

    height: float
    sigma: float
    share: float
    certain: float
    camera: Array

    @property
    def believed(self) -> bool:
        """True when it is more than the views' scatter makes, and left-out views are predicted better with it."""
        return self.height > SIGNIFICANT * self.sigma and self.certain > CERTAIN


def bend_of(adjustment: Adjustment, state: AdjustmentState) -> Bend:
    """The bend that the dots speak of, at the solution of an adjustment to pictures alone, lens and poses free."""
    whole, middle, half = _whole(adjustment)
    lens, information, gradient, parts, wide = _normal(adjustment, state)
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))

    def solved(h: Array, g: Array) -> Array:
        unit = scale[: len(g)]
        return np.asarray(unit * np.linalg.lstsq(h * unit[:, None] * unit, unit * g, rcond=1e-12)[0])

    found = solved(information, gradient)
    over = surface_shapes((whole - middle) / half)
    heights = over @ found[len(lens) :]
    left = [solved(information - h, gradient - g) for h, g in parts]
    flat = slice(0, len(lens))
    without = [solved((information - h)[flat, flat], (gradient - g)[flat]) for h, g in parts]
    gain = np.array(
        [
            np.sum((w[:, -1] - w[:, flat] @ plain) ** 2) - np.sum((w[:, -1] - w[:, :-1] @ bent) ** 2)
            for w, plain, bent in zip(wide, without, left, strict=True)
        ]
    )
    others = np.array([over @ values[len(lens) :] for values in left])
    count = len(parts)
    spread = np.sqrt((count - 1) / count * np.sum((others - others.mean(axis=0)) ** 2, axis=0))
    low, high = int(np.argmin(heights)), int(np.argmax(heights))
    camera = np.zeros(9)
    camera[lens] = found[: len(lens)]
    size_m = float(heights[high] - heights[low])
    certain = float(gain.sum() / max(np.sqrt(count) * gain.std(ddof=1), 1e-9))
    return Bend(size_m, float(np.hypot(spread[low], spread[high])), size_m / (2 * half), certain, camera)


def untold_by_bend(adjustment: Adjustment, state: AdjustmentState) -> Array:
    """What a bend that is not believed may have moved the camera's parameters, (4, 9): rows whose squares add up.

    At the solution of an adjustment to pictures alone. A board is bent by about as much as boards usually are, and the
    views tell more of it or less: views from one side tell nothing, and take it for another focal length. The first
    row is what the likeliest bend would move, the others what is left of the usual one.
    """
    whole, middle, half = _whole(adjustment)
    lens, information, gradient, *_ = _normal(adjustment, state)
    size = len(lens)
    # Of two columns of points none stands out: a board of so few has no such bend.
    rise = np.ptp(surface_shapes((whole - middle) / half), axis=0)
    usual = np.divide(USUAL * 2 * half, rise, out=np.zeros(SHAPES), where=rise > LEAST_RISE)
    # In deviations of the usual bend, and in parameters of one size.
    scale = np.r_[1 / np.sqrt(np.maximum(np.diag(information)[:size], 1e-30)), usual]
    unit = information * scale[:, None] * scale + np.diag(np.r_[np.zeros(size), np.ones(SHAPES)])
    inverse = np.linalg.pinv(unit)
    found = inverse @ (scale * gradient)
    flat = np.linalg.pinv(unit[:size, :size])
    moved = np.zeros((1 + SHAPES, 9))
    moved[0, lens] = found[:size] - flat @ (scale * gradient)[:size]
    root = np.linalg.cholesky(inverse[size:, size:] + 1e-12 * np.eye(SHAPES))
    moved[1:, lens] = (flat @ unit[:size, size:] @ root).T
    moved[:, lens] *= scale[:size]
    return moved


def _normal(
    adjustment: Adjustment, state: AdjustmentState
) -> tuple[NDArray[np.intp], Array, Array, list[tuple[Array, Array]], list[Array]]:
    """The free terms of the lens, normal equations of these and the three shapes, those of each view, and its rows."""
    lens = np.flatnonzero(adjustment.free[CAMERA])
    prior, pull = _lens_prior(adjustment, state, lens)
    wide = [_bent_rows(adjustment, k, state, lens, arm=False) for k in range(len(adjustment.views))]
    parts = [(rows[:, :-1].T @ rows[:, :-1], rows[:, :-1].T @ rows[:, -1]) for rows in wide]
    information = prior + np.sum([h for h, _ in parts], axis=0)
    gradient = pull + np.sum([g for _, g in parts], axis=0)
    return lens, information, gradient, parts, wide


def moved_by_bend(adjustment: Adjustment, state: AdjustmentState) -> Array:
    """What the shared parameters (27,) would move if the board might be bent, at a solution with the arm's poses. One
    step from there, with what is free in the adjustment and the three shapes; what is held does not move."""
    free = np.flatnonzero(adjustment.free)
    information, gradient = _lens_prior(adjustment, state, free)
    for k in range(len(adjustment.views)):
        rows = _bent_rows(adjustment, k, state, free, arm=True)
        information += rows[:, :-1].T @ rows[:, :-1]
        gradient += rows[:, :-1].T @ rows[:, -1]
    unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    found = unit * np.linalg.lstsq(information * unit[:, None] * unit, unit * gradient, rcond=1e-12)[0]
    moved = np.zeros(len(adjustment.free))
    moved[free] = found[: len(free)]
    return moved


def _lens_prior(adjustment: Adjustment, state: AdjustmentState, free: NDArray[np.intp]) -> tuple[Array, Array]:
    """Information and gradient of what is known of any lens, for the `free` parameters and the three shapes."""
    rows, right = adjustment.lens_prior(state)
    size = len(free) + SHAPES
    information, gradient = np.zeros((size, size)), np.zeros(size)
    information[: len(free), : len(free)] = (rows.T @ rows)[np.ix_(free, free)]
    gradient[: len(free)] = (rows.T @ right)[free]
    return information, gradient


def _bent_rows(adjustment: Adjustment, k: int, state: AdjustmentState, free: NDArray[np.intp], *, arm: bool) -> Array:
    """Rows of view `k`: the `free` parameters, the three shapes, the residual; its own pose is eliminated. With `arm`
    the reported flange pose counts."""
    _, middle, half = _whole(adjustment)
    parts = [(name, rows, right) for name, rows, right, _ in adjustment.rows_of(k, state)]
    if arm:
        parts.insert(0, ("arm", *adjustment.arm_prior(k, state)))
    stacked = []
    for name, rows, right in parts:
        bent = np.zeros((len(rows), SHAPES))
        if name == "dots":
            height = rows[:, 21:24] @ state.base_from_board.rotation[:, 2]
            bent = height[:, None] * np.repeat(surface_shapes((adjustment.views[k].points - middle) / half), 2, axis=0)
        stacked.append(np.column_stack([rows[:, free], bent, right, rows[:, FLANGE]]))
    every = np.vstack(stacked)
    pose = np.linalg.qr(every[:, -6:])[0]
    return np.asarray(every[:, :-6] - pose @ (pose.T @ every[:, :-6]))


def _whole(adjustment: Adjustment) -> tuple[Array, Array, float]:
    """The points (n, 3) of the view that shows most of the board, their middle, and half their diagonal."""
    whole = max((v.points for v in adjustment.views), key=len)
    return whole, 0.5 * (whole.min(axis=0) + whole.max(axis=0)), 0.5 * float(np.linalg.norm(np.ptp(whole, axis=0)))


def surface_shapes(at: Array) -> Array:
    """The second-degree shapes (n, 3) at places (n, 3) in half diagonals: along x, twisted, along y."""
    x, y = at[:, 0], at[:, 1]
    return np.column_stack([x * x, x * y, y * y])

"""Is the board flat? What a board bent or twisted like a second-degree surface would explain, and what it did.

A bent board moves focal length and principal point by many times their formal deviation, and leaves small residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.measure.calibration.solve.adjustment import Adjustment
from cell.measure.calibration.solve.normal import CAMERA, FLANGE, AdjustmentState
from cell.measure.geometry.camera import Array

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
    """The free terms of the lens, normal equations of these and the three shapes, those of each view, and its rows.

    Poses are eliminated.
    """
    _, middle, half = _whole(adjustment)
    lens = np.flatnonzero(adjustment.free[CAMERA])
    lens_rows, lens_right = adjustment.lens_prior(state)
    size = len(lens) + SHAPES
    prior, pull = np.zeros((size, size)), np.zeros(size)
    prior[: len(lens), : len(lens)] = (lens_rows.T @ lens_rows)[np.ix_(lens, lens)]
    pull[: len(lens)] = (lens_rows.T @ lens_right)[lens]
    parts, wide = [], []
    for k, view in enumerate(adjustment.views):
        for _, rows, residual, _ in adjustment.rows_of(k, state):
            height = rows[:, 21:24] @ state.base_from_board.rotation[:, 2]
            shapes = np.repeat(surface_shapes((view.points - middle) / half), 2, axis=0)
            wanted = np.column_stack([rows[:, lens], height[:, None] * shapes, residual])
            pose = np.linalg.qr(rows[:, FLANGE])[0]
            wanted -= pose @ (pose.T @ wanted)
            parts.append((wanted[:, :-1].T @ wanted[:, :-1], wanted[:, :-1].T @ wanted[:, -1]))
            wide.append(wanted)
    information = prior + np.sum([h for h, _ in parts], axis=0)
    gradient = pull + np.sum([g for _, g in parts], axis=0)
    return lens, information, gradient, parts, wide


def moved_by_bend(adjustment: Adjustment, state: AdjustmentState) -> Array:
    """What the shared parameters (27,) would move if the board might be bent, at a solution with the arm's poses.

    One step from there, with what is free in the adjustment and the three shapes; what is held does not move.
    """
    _, middle, half = _whole(adjustment)
    free = np.flatnonzero(adjustment.free)
    lens_rows, lens_right = adjustment.lens_prior(state)
    size = len(free) + SHAPES
    information, gradient = np.zeros((size, size)), np.zeros(size)
    information[: len(free), : len(free)] = (lens_rows.T @ lens_rows)[np.ix_(free, free)]
    gradient[: len(free)] = (lens_rows.T @ lens_right)[free]
    for k, view in enumerate(adjustment.views):
        own_rows, own_right = adjustment.arm_prior(k, state)
        parts = [
            ("arm", own_rows, own_right),
            *((n, rows, right) for n, rows, right, _ in adjustment.rows_of(k, state)),
        ]
        stacked = []
        for name, rows, right in parts:
            bent = np.zeros((len(rows), SHAPES))
            if name == "dots":
                height = rows[:, 21:24] @ state.base_from_board.rotation[:, 2]
                bent = height[:, None] * np.repeat(surface_shapes((view.points - middle) / half), 2, axis=0)
            stacked.append(np.column_stack([rows[:, free], bent, right, rows[:, FLANGE]]))
        every = np.vstack(stacked)
        pose = np.linalg.qr(every[:, -6:])[0]
        wanted = every[:, :-6] - pose @ (pose.T @ every[:, :-6])
        information += wanted[:, :-1].T @ wanted[:, :-1]
        gradient += wanted[:, :-1].T @ wanted[:, -1]
    unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    found = unit * np.linalg.lstsq(information * unit[:, None] * unit, unit * gradient, rcond=1e-12)[0]
    moved = np.zeros(len(adjustment.free))
    moved[free] = found[: len(free)]
    return moved


def _whole(adjustment: Adjustment) -> tuple[Array, Array, float]:
    """The points (n, 3) of the view that shows most of the board, their middle, and half their diagonal."""
    whole = max((v.points for v in adjustment.views), key=len)
    return whole, 0.5 * (whole.min(axis=0) + whole.max(axis=0)), 0.5 * float(np.linalg.norm(np.ptp(whole, axis=0)))


def surface_shapes(at: Array) -> Array:
    """The second-degree shapes (n, 3) at places (n, 3) in half diagonals: along x, twisted, along y."""
    x, y = at[:, 0], at[:, 1]
    return np.column_stack([x * x, x * y, y * y])

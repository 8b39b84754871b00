"""Does one picture, or do all from one on, want another camera: another zoom, focus or crop, of the same size?

Its own pose takes up most of what a wrong focal length does to a board, so that its points miss their places by
little, and it pulls the camera of all. What tells is by how much less the points miss when that picture alone has
focal lengths and a principal point of its own, over what the points scatter by: an F-test for each picture, and for
those from each on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cell.measure.calibration.solve.blocks import FLANGE, SHARED
from cell.measure.calibration.solve.intrinsics import Intrinsics, adjustment_of
from cell.measure.geometry.camera import Array
from cell.measure.vision.board.view import BoardView

LEAST_OTHERS = 5
"""Pictures that a picture has to disagree with: of fewer, any may be the foreign one."""
FOREIGN = 10.0
"""F from which a picture may be foreign. Chance brings 2 among ten pictures, 7 once in 10⁵ of them."""
AT_ONCE = 2.5
"""So many times the F of two mixtures of pictures from before and after."""
ABOUT = 0.8
"""Splits of so much of the largest F are looked at, too."""
LEAST_PART = 3
"""Pictures before and after a change of the camera that may tell one."""
ALONE = 4.0
"""So many times the F of any other, once it is left out: bent boards and lenses of another kind make many large."""
ROUNDS = 3
UNTOLD = 1e-9
"""Share of the information in a direction of the camera that a picture says nothing about."""


def foreign_view(found: Intrinsics, views: Sequence[BoardView]) -> tuple[int, float] | None:
    """Which of the views is of another camera than the others, and its F; None where none is, or it cannot be told.

    `found` is the camera of all `views`, which are of different stops.
    """
    if len(views) <= LEAST_OTHERS:
        return None
    # With the foreign one among them the views may have chosen too plain a lens.
    roomy = replace(found, model=replace(found.model, k1=True, k2=True, one_focal=False))
    wants = own_cameras(roomy, views)
    odd = int(np.argmax(wants))
    if wants[odd] < FOREIGN:
        return None
    others = own_cameras(roomy, [view for k, view in enumerate(views) if k != odd])
    return (odd, float(wants[odd])) if wants[odd] > ALONE * others.max() else None


def parted_at(found: Intrinsics, views: Sequence[BoardView]) -> list[int]:
    """Views from each of which on all may want another camera than those before, by the test alone; else empty.

    Where any half of the views wants one, or single views still do beside those of their own part, board or lens are
    not what the model has, and nothing was changed in between.
    """
    count = len(views)
    if count < 2 * LEAST_PART:
        return []
    splits = [np.arange(count) >= k for k in range(LEAST_PART, count - LEAST_PART + 1)]
    mixed = [np.arange(count) % step < step // 2 for step in (2, 4)]
    wants = own_cameras(found, views, [*splits, *mixed])
    split, rest = wants[: len(splits)], wants[len(splits) :]
    if split.max() < max(FOREIGN, AT_ONCE * rest.max()):
        return []
    at = [LEAST_PART + int(k) for k in np.flatnonzero(split > ABOUT * split.max())]
    return [
        k for k in at if ALONE * max(own_cameras(found, part).max() for part in (views[:k], views[k:])) < split.max()
    ]


def own_cameras(
    found: Intrinsics, views: Sequence[BoardView], groups: Sequence[NDArray[np.bool_]] | None = None
) -> Array:
    """For each view (n,) the F of focal lengths and a principal point of its own, with the lens that all share.

    Or for each of the groups, masks (n,) of views. The gain is that of one step from the adjustment of all views, as in
    a score test.
    """
    adjustment, start = adjustment_of(found.model, found.camera, views)
    state = adjustment.solve(start, ROUNDS).state
    free = np.flatnonzero(adjustment.free)
    parts: list[tuple[Array, Array]] = []
    squares, freedom = 0.0, -len(free)
    for k in range(len(views)):
        (_, rows, residuals, _), *_ = adjustment.rows_of(k, state)
        # Without what the view's own pose takes up.
        basis = np.linalg.qr(rows[:, FLANGE])[0]
        shared = (rows - basis @ (basis.T @ rows))[:, :SHARED][:, free]
        left = residuals - basis @ (basis.T @ residuals)
        parts.append((shared.T @ shared, shared.T @ left))
        squares, freedom = squares + float(left @ left), freedom + len(left) - basis.shape[1]
    lens, _ = adjustment.lens_prior(state)
    information = lens[:, free].T @ lens[:, free] + np.sum([h for h, _ in parts], axis=0)
    scale = np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information / scale[:, None] / scale) / scale[:, None] / scale
    if groups is None:
        return np.array([_gain(h, g, inverse, squares, freedom) for h, g in parts])
    gains = []
    for group in groups:
        some = [part for part, inside in zip(parts, group, strict=True) if inside]
        h, g = np.sum([h for h, _ in some], axis=0), np.sum([g for _, g in some], axis=0)
        gains.append(_gain(h, g, inverse, squares, freedom))
    return np.array(gains)


def _gain(information: Array, gradient: Array, inverse: Array, squares: float, freedom: int) -> float:
    """F of a view, from what it brings for the free parameters of the camera, of which the first four become its own,
    and the `inverse` information of all views."""
    across = information[:, :4]
    own = information[:4, :4] - across.T @ inverse @ across
    scale = np.sqrt(np.diag(information)[:4])
    values, vectors = np.linalg.eigh(own / scale[:, None] / scale)
    told = values > UNTOLD
    along = (vectors.T @ (gradient[:4] / scale))[told]
    gained, count = float(np.sum(along**2 / values[told])), int(told.sum())
    left = max(squares - gained, 1e-12)
    return gained / max(count, 1) / (left / max(freedom - count, 1))

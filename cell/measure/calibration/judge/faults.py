"""Faults of a calibration's set-up: exchanged pictures, a bent board, a slipped mount, a wrong lead, another zoom.

Each check looks at what only its own fault disturbs: pictures against the flange's turns; the dots of each view by
themselves; where the views put the board, before and after. A picture of another zoom or focus is told by an F-test:
by how much less the points miss when it alone has focal lengths and a principal point of its own.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import NDArray

from cell.measure.calibration.solve.adjustment import Adjusted
from cell.measure.calibration.solve.intrinsics import Intrinsics, adjustment_of, data_of, surface_shapes
from cell.measure.calibration.solve.normal import CAMERA, FLANGE, SHARED, ViewData, dots_block
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import angle_apart, difference, from_parts, perturbed
from cell.measure.vision.board.view import BoardView
from drivers.errors import RefusedError

LARGEST_TURN = float(np.deg2rad(0.5))
"""How much more or less than the flange a board may seem to turn between two views; repeatability is far below."""
LARGEST_BEND = 1.5e-3
"""How far a board may stand out of its plane, as a share of its diagonal."""
LARGEST_SLIP_M, LARGEST_SLIP_RAD = 0.1e-3, float(np.deg2rad(0.03))
"""A change of the mount within the collection that may stay."""
SCALE_RANGE = (0.98, 1.02)
"""Travel found per travel commanded: what is beyond is no screw's error."""
CHANCE = 1e-6
LEAST_VIEWS_APART = 3
OWN_FIGURES = 3
"""With six, waves of 0.07 mrad in an arm's joints looked like a slip of 0.18 mm in 1 of 24 collections."""


def refuse_exchanged(names: Sequence[str], flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> None:
    """Refuse views whose pictures belong to other flange poses; `boards` are camera_from_board by picture. Whatever the
    hand-eye, the flange turns between two views by the angle by which the board seems to turn."""
    count = len(flanges)
    apart = np.array([[[_apart(flanges, boards, i, p=p, j=j, q=j) for j in range(count)] for p in range(count)]
                      for i in range(count)])  # fmt: skip
    own = np.array([np.median(np.delete(apart[i, i], i)) for i in range(count)])
    odd = np.flatnonzero(own > LARGEST_TURN)
    if not len(odd):
        return
    good = np.setdiff1d(np.arange(count), odd)
    which = ", ".join(names[int(i)] for i in odd[:4]) + (", …" if len(odd) > 4 else "")
    found = (
        f"{len(odd)} of {count} pictures do not belong to their flange poses ({which}): the board turned by up to "
        f"{np.degrees(own.max()):.1f}° more or less than the flange, allowed {np.degrees(LARGEST_TURN):g}°"
    )
    advice = "see how pictures are paired with poses (no frame may be lost or kept back), then collect anew"
    if len(good) >= LEAST_VIEWS_APART:
        pairs = [(i, j) for i, j in combinations(odd.tolist(), 2)
                 if max(np.median(apart[i, j][good]), np.median(apart[j, i][good])) < LARGEST_TURN]  # fmt: skip
        if pairs:
            text = " and ".join(f"those of {names[i]} and {names[j]} are exchanged" for i, j in pairs)
            raise RefusedError(f"{found}; {text}: {advice}")
    for shift, words in ((1, "one late"), (-1, "one early")):
        if np.mean(_own_shifted(flanges, boards, shift) < LARGEST_TURN) > 0.7:
            raise RefusedError(f"{found}; the frames come {words}: {advice}")
    raise RefusedError(f"{found}; {advice}, and see that the board lies still")


def _own_shifted(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3], shift: int) -> NDArray[np.float64]:
    """Of each flange (n,), rad: the median `_apart` if each had the picture so many places later."""
    count = len(flanges)
    order = [(i + shift) % count for i in range(count)]
    return np.array([
        np.median([_apart(flanges, boards, i, p=order[i], j=j, q=order[j]) for j in range(count) if j != i])
        for i in range(count)
    ])  # fmt: skip


def _apart(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3], i: int, p: int, j: int, q: int) -> float:
    """`angle_apart` of flange i with picture p against flange j with picture q."""
    return 0.0 if i == j else angle_apart(flanges[i], boards[p], flanges[j], boards[q])


def refuse_bent(board: str, adjusted: Adjusted, views: Sequence[ViewData]) -> None:
    """Refuse a board that is bent or twisted: dots out of its plane like a second-degree surface. Every view has a pose
    of its own here and the lens is free, so that arm, rail and mount play no part."""
    state = adjusted.state
    whole = max((v.points for v in views), key=len)
    middle = 0.5 * (whole.min(axis=0) + whole.max(axis=0))
    half = 0.5 * float(np.linalg.norm(np.ptp(whole, axis=0)))
    rows, right = [], []
    for view, flange, rail in zip(views, state.flanges, state.rails, strict=True):
        if len(view.points) < 6:
            continue
        residual, jacobian = dots_block(state, view, flange, float(rail))
        # Board columns are derivatives by a move of the board: along its normal they are what a dot's height does.
        height = jacobian[:, :, 21:24] @ state.base_from_board.rotation[:, 2]
        shapes = height[:, :, None] * surface_shapes((view.points - middle) / half)[:, None, :]
        wanted = np.concatenate([jacobian[:, :, CAMERA][:, :, :8], shapes], axis=2).reshape(-1, 11)
        pose, _ = np.linalg.qr(jacobian[:, :, FLANGE].reshape(-1, 6))
        both = np.column_stack([wanted, residual.ravel()]) / np.repeat(view.sigma, 2)[:, None]
        pose = np.linalg.qr(pose / np.repeat(view.sigma, 2)[:, None])[0]
        both -= pose @ (pose.T @ both)
        rows.append(both[:, :-1])
        right.append(both[:, -1])
    design, measured = np.concatenate(rows), np.concatenate(right)
    scale = np.linalg.norm(design, axis=0)
    covariance = np.linalg.inv((design / scale).T @ (design / scale)) / scale[:, None] / scale
    solution = covariance @ design.T @ measured
    freedom = len(measured) - 11 - 6 * len(rows)
    variance = float(np.sum((measured - design @ solution) ** 2)) / freedom
    bend = solution[8:]
    test = float(bend @ np.linalg.solve(covariance[8:, 8:] * variance, bend)) / 3
    heights = surface_shapes((whole - middle) / half) @ bend
    size, allowed = float(np.ptp(heights)), LARGEST_BEND * 2 * half
    if size > allowed and scipy.special.fdtrc(3, freedom, test) < CHANCE:
        across = [
            np.ptp(surface_shapes((whole - middle) * axis / half) @ bend) for axis in (np.eye(3)[0], np.eye(3)[1])
        ]
        raise RefusedError(
            f"the {board} board is not flat: its dots stand {1e3 * size:.2f} mm out of a plane "
            f"({1e3 * across[0]:.2f} mm along its rows, {1e3 * across[1]:.2f} mm down its columns), allowed "
            f"{1e3 * allowed:.2f} mm; see how it is fastened, flatten or replace it, then run `cell calibrate`"
        )


def refuse_slipped(
    camera: str, names: Sequence[str], adjusted: Adjusted, views: Sequence[ViewData], boards: Sequence[pin.SE3]
) -> None:
    """Refuse a collection in the middle of which the camera moved on the flange; `boards` are camera_from_board.

    Where the views put the board in the base is explained by one hand-eye, board and rail, and better by a second
    hand-eye from some view on. An F test tells, so that an arm that repeats worse than stated raises no alarm. What a
    few joints err by at a posture shows in all six figures of a view: they count as `OWN_FIGURES`.
    """
    state, count = adjusted.state, len(views)
    if count < 2 * LEAST_VIEWS_APART:
        return
    hand, rail = state.flange_from_camera, state.rail_direction

    def place(k: int, h: pin.SE3, direction: Array) -> pin.SE3:
        return views[k].base_from_flange * h * from_parts(views[k].rail * direction) * boards[k]

    blocks, right, slips = [], [], []
    step = 1e-6
    for k in range(count):
        here = place(k, hand, rail)
        by_hand = np.column_stack(
            [difference(place(k, perturbed(hand, step * e), rail), here) / step for e in np.eye(6)]
        )
        by_rail = np.column_stack([difference(place(k, hand, rail + step * e), here) / step for e in np.eye(3)])
        root = np.linalg.inv(np.linalg.cholesky(_scatter(adjusted, views[k], here)))
        blocks.append(root @ np.hstack([by_hand, by_rail, -np.eye(6)]))
        slips.append(root @ by_hand)
        right.append(-root @ difference(here, state.base_from_board))
    design, measured = np.concatenate(blocks), np.concatenate(right)
    plain = _squares(design, measured)[0]
    best: tuple[float, int, Array] = (0.0, 0, np.zeros(6))
    freedom = len(measured) - np.linalg.matrix_rank(design) - 6
    for first in range(LEAST_VIEWS_APART, count - LEAST_VIEWS_APART + 1):
        later = np.concatenate([slip * (k >= first) for k, slip in enumerate(slips)])
        squares, solution = _squares(np.hstack([later, design]), measured)
        test = (plain - squares) / 6 / max(squares / freedom, 1e-12)
        if test > best[0]:
            best = float(test), first, solution[:6]
    test, first, moved = best
    shift, turn = float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:]))
    chance = scipy.special.fdtrc(OWN_FIGURES, freedom * OWN_FIGURES / 6, test) * count
    if chance < CHANCE and (shift > LARGEST_SLIP_M or turn > LARGEST_SLIP_RAD):
        raise RefusedError(
            f"the {camera} camera's mount slipped on the flange before {names[first]}: from there on the camera sits "
            f"{1e3 * shift:.2f} mm and {np.degrees(turn):.3f}° from where it was, allowed {1e3 * LARGEST_SLIP_M:g} mm "
            f"and {np.degrees(LARGEST_SLIP_RAD):.2f}°; tighten the mount and the claw"
            f"{', see whether the rail loses steps' if camera == 'scan' else ''}, then run `cell calibrate`"
        )


def _scatter(adjusted: Adjusted, view: ViewData, base_from_board: pin.SE3) -> Array:
    """Covariance (6, 6) of where one view puts the board, from the arm, the rail and a little of the picture."""
    p = adjusted.priors
    lever = np.eye(6)
    lever[:3, 3:] = -pin.skew(base_from_board.translation - view.base_from_flange.translation)
    arm = np.diag(np.repeat([p.arm_translation**2 + p.rail**2, p.arm_rotation**2], 3))
    picture = np.diag(np.repeat([1e-6**2, 1e-5**2], 3))
    return np.asarray(lever @ arm @ lever.T + picture, dtype=np.float64)


def _squares(design: Array, measured: Array) -> tuple[float, Array]:
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-30)
    solution = np.linalg.lstsq(design / scale, measured, rcond=1e-10)[0]
    left = measured - (design / scale) @ solution
    return float(left @ left), np.asarray(solution / scale, dtype=np.float64)


def refuse_wrong_lead(rail_direction: Array, lead: float) -> None:
    """Refuse a rail that moves much more or less than commanded under the configured `lead` in m per turn."""
    scale = float(np.linalg.norm(rail_direction))
    if not SCALE_RANGE[0] <= scale <= SCALE_RANGE[1]:
        raise RefusedError(
            f"the rail moves {scale:.3f} mm per mm commanded, allowed {SCALE_RANGE[0]:g} to {SCALE_RANGE[1]:g}: "
            f"rail.lead is configured as {1e3 * lead:g} mm, the screw seems to have {1e3 * lead * scale:.3g} mm; "
            "correct rail.lead (or steps_per_turn, microsteps), then run `cell calibrate`"
        )


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
    `found` is the camera of all `views`, which are of different stops."""
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
    adjustment, start = adjustment_of(found.model, found.camera, data_of(views, found.camera))
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

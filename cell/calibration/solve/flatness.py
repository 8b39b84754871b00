"""The whole measuring chain on one figure: how flat the board comes out, its stripe points taken to the arm's base.

Pixel, light plane, hand-eye and reported flange pose all count. Leave-one-out says it of frames that the calibration
has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.calibration.observations import ScanObservation
from cell.calibration.solve.adjustment import Adjusted, Adjustment, Priors, shared_mask
from cell.calibration.solve.blocks import State
from cell.calibration.solve.joint import Staged, residuals_as_reported, start_state, view_data, without
from cell.calibration.solve.starts import stripe_pixels
from cell.geometry.camera import Array
from cell.geometry.light_plane import LightPlane
from cell.geometry.poses import transform

# Repeatabilities of arms that are tried, m and rad: the one that predicts left-out frames best is taken.
ARMS = ((1e-5, 2e-5), (3e-5, 6e-5), (1e-4, 2e-4), (3e-4, 6e-4), (1e-3, 2e-3))
FOLDS = 7
# Of arms that predict about as well, the least repeatable is believed.
AS_GOOD = 1.05


@dataclass(frozen=True, eq=False)
class Flatness:
    """Distances in m of stripe points from one plane: RMS, 95th percentile, number of points, RMS per frame.

    `extent` (2,) in m along the two main directions of the points in that plane.
    """

    rms: float
    p95: float
    points: int
    extent: Array
    per_frame: list[float]


def flatness(state: State, observations: Sequence[ScanObservation], staged: Staged) -> Flatness | None:
    """Flatness of the board in the base over all frames with a stripe; None without any."""
    clouds = [_in_base(state, o, staged, k) for k, o in enumerate(observations)]
    if sum(len(c) > 0 for c in clouds) < 1:
        return None
    return _flat(clouds, LightPlane.fit(np.concatenate(clouds)))


def leave_one_out(
    observations: Sequence[ScanObservation], staged: Staged, state: State, priors: Priors, tangential: bool
) -> Flatness | None:
    """Each frame measured with the calibration of the others, against the plane that the others' points make."""
    lit = [k for k in range(len(observations)) if staged.plane is not None and len(staged.plane.rows[k])]
    if len(lit) < 4:
        return None
    clouds, distances = [], []
    for k in range(len(observations)):
        if k not in lit:
            clouds.append(np.zeros((0, 3)))
            distances.append(np.zeros(0))
            continue
        others = [o for j, o in enumerate(observations) if j != k]
        other = _adjust(others, without(staged, k), state, priors, tangential, 1).state
        rest = [_in_base(other, o, staged, j) for j, o in enumerate(observations) if j != k]
        mine = _in_base(other, observations[k], staged, k)
        clouds.append(mine)
        distances.append(LightPlane.fit(np.concatenate(rest)).distances(mine))
    return _summary(clouds, distances)


def choose_arm(
    observations: Sequence[ScanObservation], staged: Staged, tangential: bool
) -> tuple[Priors, dict[str, float]]:
    """The arm's repeatability that predicts left-out frames best (loosest of equals), and the figure of each tried.

    The figure is the RMS of the stripe's distance from the board in mm, of the dots in px when there is no stripe.
    """
    figures: dict[str, float] = {}
    tried: list[tuple[float, Priors]] = []
    folds = min(FOLDS, len(observations))
    whole = start_state(staged)
    for shift, turn in ARMS:
        adjusted = _adjust(observations, staged, whole, Priors(arm_translation=shift, arm_rotation=turn), tangential, 2)
        whole, priors = adjusted.state, adjusted.priors
        dots, stripe = [], []
        for fold in range(folds):
            kept = [k for k in range(len(observations)) if k % folds != fold]
            part = staged if staged.plane is None else _with_rows(staged, [staged.plane.rows[k] for k in kept])
            other = _adjust([observations[k] for k in kept], part, whole, priors, tangential, 0).state
            for k in range(fold, len(observations), folds):
                chosen = np.empty(0, dtype=np.intp) if staged.plane is None else staged.plane.rows[k]
                off, away = residuals_as_reported(other, view_data(observations[k], chosen))
                dots.append(off.ravel())
                stripe.append(away)
        away = np.concatenate(stripe) if stripe else np.zeros(0)
        off = np.concatenate(dots) if dots else np.zeros(0)
        if not len(away) and not len(off):
            continue
        value = 1e3 * float(np.sqrt(np.mean(away**2))) if len(away) else float(np.sqrt(np.mean(off**2)))
        figures[f"{1e3 * shift:g}"] = value
        if np.isfinite(value):
            tried.append((value, priors))
    if not tried:
        return Priors(), figures
    least = min(value for value, _ in tried)
    return [priors for value, priors in tried if value < AS_GOOD * least][-1], figures


def _with_rows(staged: Staged, rows: list[np.ndarray]) -> Staged:
    assert staged.plane is not None
    return replace(staged, plane=replace(staged.plane, rows=rows))


def _adjust(
    observations: Sequence[ScanObservation],
    staged: Staged,
    start: State,
    priors: Priors,
    tangential: bool,
    variance_rounds: int,
) -> Adjusted:
    rows = [np.empty(0, dtype=np.intp)] * len(observations) if staged.plane is None else staged.plane.rows
    views = [view_data(o, r) for o, r in zip(observations, rows, strict=True)]
    free = shared_mask(plane=staged.plane is not None, rail=False, tangential=tangential)
    return Adjustment(views, free, priors).solve(start, variance_rounds)


def _in_base(state: State, observation: ScanObservation, staged: Staged, index: int) -> Array:
    """Stripe points (n, 3) of one frame in the base, at the reported flange pose."""
    rows = None if staged.plane is None else staged.plane.rows[index]
    if state.plane is None or observation.profile is None or rows is None or not len(rows):
        return np.zeros((0, 3))
    seen = state.plane.intersect(state.camera.rays(stripe_pixels(observation.profile, rows)))
    base_from_camera = observation.base_from_flange * state.flange_from_camera
    return transform(base_from_camera, seen[np.isfinite(seen).all(axis=1)])


def _flat(clouds: Sequence[Array], plane: LightPlane) -> Flatness:
    return _summary(clouds, [plane.distances(c) for c in clouds])


def _summary(clouds: Sequence[Array], distances: Sequence[Array]) -> Flatness:
    cloud, away = np.concatenate(clouds), np.concatenate(distances)
    centred = cloud - cloud.mean(axis=0)
    spread = centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
    per_frame = [float(np.sqrt(np.mean(d**2))) if len(d) else float("nan") for d in distances]
    return Flatness(
        float(np.sqrt(np.mean(away**2))),
        float(np.percentile(np.abs(away), 95)),
        len(away),
        np.ptp(spread, axis=0),
        per_frame,
    )

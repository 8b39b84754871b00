"""The whole measuring chain on one figure: how flat the board comes out, its stripe points taken to the arm's base.

Pixel, light plane, hand-eye and reported flange pose all count. Leave-one-out says it of frames that the calibration
has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.solve.adjustment import Adjustment
from cell.measure.calibration.solve.choice import Solution
from cell.measure.calibration.solve.joint import Staged
from cell.measure.calibration.solve.normal import AdjustmentState
from cell.measure.calibration.solve.starts import stripe_pixels
from cell.measure.geometry.camera import Array
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import transform


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


def flatness(state: AdjustmentState, observations: Sequence[ScanObservation], staged: Staged) -> Flatness | None:
    """Flatness of the board in the base over all frames with a stripe; None without any."""
    clouds = [_in_base(state, o, staged, k) for k, o in enumerate(observations)]
    if sum(len(c) > 0 for c in clouds) < 1:
        return None
    return _flat(clouds, LightPlane.fit(np.concatenate(clouds)))


def leave_one_out(observations: Sequence[ScanObservation], staged: Staged, solution: Solution) -> Flatness | None:
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
        other = solution.left.states[k]
        if solution.joint:
            # The step to it was a linear one: now to the end.
            views = [view for j, view in enumerate(solution.views) if j != k]
            other = Adjustment(views, solution.free, solution.adjusted.priors).solve(other, variance_rounds=0).state
        rest = [_in_base(other, o, staged, j) for j, o in enumerate(observations) if j != k]
        mine = _in_base(other, observations[k], staged, k)
        clouds.append(mine)
        distances.append(LightPlane.fit(np.concatenate(rest)).distances(mine))
    return _summary(clouds, distances)


def _in_base(state: AdjustmentState, observation: ScanObservation, staged: Staged, index: int) -> Array:
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

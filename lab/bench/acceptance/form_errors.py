"""Figures of the trade from measured points: flatness, probing error in form and size, sphere spacing.

After VDI/VDE 2634 part 2 and ISO 10360-13, in own words. Both fit by least squares and judge what is left: the first
over all points but the few per mille that it lets go, the second over all points and over 95 % of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import RefusedError

Array = NDArray[np.float64]

LET_GO = 0.003
"""Share of the points that VDI/VDE 2634 part 2 lets the tester leave out of a form error."""
MOST = 0.95
"""Share of the points that the second form error of ISO 10360-13 is about."""
LEAST_POINTS = 50


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A sphere: `centre` (3,) and `radius` in m, and the points' `deviations` (n,) from it, outside positive."""

    centre: Array
    radius: float
    deviations: Array


def fit_sphere(points: Array) -> SphereFit:
    """Least-squares sphere of points (n, 3) in m, radius free. Raises `RefusedError` for too few points."""
    _enough(points, "sphere")
    middle = points.mean(axis=0)
    near = points - middle
    # |p|² = 2 c·p + (r² − |c|²) starts the Gauss–Newton on the distances themselves.
    columns = np.column_stack([2 * near, np.ones(len(near))])
    c, offset = np.split(np.linalg.lstsq(columns, np.sum(near**2, axis=1), rcond=None)[0], [3])
    radius = float(np.sqrt(offset[0] + c @ c))
    for _ in range(20):
        away = near - c
        length = np.linalg.norm(away, axis=1)
        step = np.linalg.lstsq(
            np.column_stack([away / length[:, None], np.ones(len(near))]), length - radius, rcond=None
        )
        c, radius = c + step[0][:3], radius + float(step[0][3])
        if np.linalg.norm(step[0]) < 1e-12:
            break
    return SphereFit(c + middle, radius, np.linalg.norm(near - c, axis=1) - radius)


def plane_deviations(points: Array) -> Array:
    """Signed distances (n,) in m of points (n, 3) from their least-squares plane."""
    _enough(points, "flat")
    centred = points - points.mean(axis=0)
    return np.asarray(centred @ np.linalg.svd(centred, full_matrices=False)[2][2])


def form_all(deviations: Array) -> float:
    """Form error over all points: largest minus smallest deviation, the 3 ‰ farthest off left out. Unit as given."""
    most = np.sort(np.abs(deviations - np.median(deviations)))[len(deviations) - 1 - int(LET_GO * len(deviations))]
    kept = deviations[np.abs(deviations - np.median(deviations)) <= most]
    return float(np.ptp(kept))


def form_95(deviations: Array) -> float:
    """Form error over 95 % of the points: the narrowest band of deviations that holds so many. Unit as given."""
    ordered = np.sort(deviations)
    count = int(np.ceil(MOST * len(ordered)))
    return float((ordered[count - 1 :] - ordered[: len(ordered) - count + 1]).min())


def cap(points: Array, centre: Array, towards: Array, angle: float) -> NDArray[np.bool_]:
    """Which points (n, 3) lie on the part of a sphere within `angle` rad of the direction `towards` (3,)."""
    away = points - centre
    cosine = away @ (towards / np.linalg.norm(towards)) / np.linalg.norm(away, axis=1)
    return np.asarray(cosine > np.cos(angle))


def _enough(points: Array, what: str) -> None:
    if len(points) < LEAST_POINTS:
        raise RefusedError(
            f"the scan of a {what} has {len(points)} points, at least {LEAST_POINTS} are needed for a fit. Is it "
            "inside the measuring volume, and does the laser light it?"
        )

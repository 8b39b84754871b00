"""Has a surface moved between two scans of it? The second one need have a few lines only.

What the surface is shaped like beside its model is in both scans: their heights over the model are compared where they
lie beside each other. A motion shows in all of them, noise and a vehicle that rocks in one line or another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import NDArray

from cell.inversion.closest import Array
from cell.inversion.correspondences import Scan, correspondences
from cell.inversion.nominal import NominalSurface
from cell.reconstruction.cloud import Cloud
from cell.reconstruction.seams import Motions

GATE_M = 5e-3
"""Points farther from where the surface was are not of it; where it has moved farther, few are left."""
BESIDE_M = 1e-3
"""Between points of the two scans that are compared."""
OUTLIER = 5.0
"""Median absolute deviations from the motion found."""
EVIDENCE = 32.0
"""Squared Mahalanobis distance above which it has moved: 6 times F(6, 28) at 0.999, for some thirty lines."""
NEIGHBOURS = 4
ROUNDS = 3
MOST_POINTS = 40_000
LEAST_M = 3e-6
"""Noise of a point that is believed."""
LEAST_MATCHED = 0.5
"""Share of the second scan's points beside the surface, against the first one's, above which it can be the same."""


@dataclass(frozen=True, eq=False)
class SurfaceMotion:
    """By what `motion` (6,) (shift m, turn rad; base axes, about the surface's origin) the surface seems to have moved.

    Its `covariance` (6, 6); `matched`, the share of the second scan's points beside the surface as it was found, in
    units of the first one's.
    """

    motion: Array
    covariance: Array
    matched: float

    @property
    def times(self) -> float:
        """How many times as far as chance takes it."""
        return float(np.sqrt(self.motion @ np.linalg.solve(self.covariance, self.motion) / EVIDENCE))

    @property
    def moved(self) -> bool:
        """Whether it has moved, or is not there any more."""
        return self.matched < LEAST_MATCHED or self.times > 1.0

    def as_dict(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "mm": [round(1e3 * float(v), 4) for v in self.motion[:3]],
            "mrad": [round(1e3 * float(v), 4) for v in self.motion[3:]],
            "sigma_mm": [round(1e3 * float(v), 4) for v in np.sqrt(np.diag(self.covariance))[:3]],
            "matched": round(self.matched, 3),
        }


def surface_motion(
    first: Cloud, second: Cloud, nominal: NominalSurface, pose: pin.SE3, prior: Array, by_poses: tuple[Motions, Motions]
) -> SurfaceMotion:
    """Between two scans of the `nominal` surface, which the first one found at `pose` (base_from_surface).

    `prior` (6, 6) is how far it may have moved at all; `by_poses` how the points of each scan move by one standard
    deviation of what the arm's poses are off by.
    """
    before = _Beside.of(first, nominal, pose, by_poses[0])
    now = _Beside.of(second, nominal, pose, by_poses[1])
    tree = scipy.spatial.cKDTree(before.feet)
    apart, pairs = map(np.asarray, tree.query(now.feet, k=NEIGHBOURS, distance_upper_bound=BESIDE_M))
    near = np.isfinite(apart).all(axis=1)
    matched = now.share * float(near.mean()) / before.share if near.any() else 0.0
    if matched < LEAST_MATCHED:
        return SurfaceMotion(np.zeros(6), prior, matched)
    pairs = pairs[near]
    risen = now.heights[near] - before.heights[pairs].mean(axis=1)
    rows, lines = now.jacobian[near], now.lines[near]
    poses = np.concatenate([now.by_poses[near], before.by_poses[pairs].mean(axis=1)], axis=1)
    kept = np.ones(len(risen), dtype=np.bool_)
    motion, covariance = np.zeros(6), prior
    for _ in range(ROUNDS):
        motion, covariance = _fitted(rows[kept], risen[kept], lines[kept], poses[kept], prior)
        left = risen - rows @ motion
        kept = np.abs(left) <= OUTLIER * float(np.median(np.abs(left))) + 1e-9
    return SurfaceMotion(motion, covariance, matched)


def _fitted(rows: Array, risen: Array, lines: NDArray[np.intp], poses: Array, prior: Array) -> tuple[Array, Array]:
    """The motion (6,) and its covariance (6, 6) from how far points (n,) have `risen`, by their derivatives (n, 6).

    What is left is of single points and of whole `lines` (n,); the `poses` (n, m) of the arm move all of a scan.
    """
    left = risen - rows @ np.linalg.lstsq(rows, risen)[0]
    number = np.bincount(lines)
    means = np.bincount(lines, left) / np.maximum(number, 1)
    point = max(LEAST_M, float(np.std(left - means[lines])))
    line = float(np.sqrt(np.sum(means**2) / max(1, int(np.count_nonzero(number)) - 6)))
    covariance = np.asarray(np.linalg.inv(rows.T @ rows / point**2 + np.linalg.inv(prior)))
    motion = covariance @ rows.T @ risen / point**2
    by_line = line * np.stack([np.bincount(lines, column) for column in rows.T])
    spread = covariance @ np.hstack([by_line, rows.T @ poses]) / point**2
    return motion, covariance + spread @ spread.T


@dataclass(frozen=True, eq=False)
class _Beside:
    """Points of a scan that lie beside the surface: their `feet` (n, 3) on it, surface frame, `heights` (n,) over it in
    m, how the heights follow a motion of the surface, `jacobian` (n, 6), and the arm's poses, `by_poses` (n, m), their
    `lines` (n,), and the `share` of the scan that they are."""

    feet: Array
    heights: Array
    jacobian: Array
    by_poses: Array
    lines: NDArray[np.intp]
    share: float

    @classmethod
    def of(cls, cloud: Cloud, nominal: NominalSurface, pose: pin.SE3, by_poses: Motions) -> _Beside:
        scan, (lines, rows) = Scan.of(cloud, MOST_POINTS), cloud.subsample(MOST_POINTS)
        found = correspondences(pose, scan, nominal, GATE_M)
        feet = found.arms - found.heights[:, None] * found.normals
        moved = by_poses(lines[found.index], rows[found.index])
        return cls(
            feet @ pose.rotation,
            found.heights,
            -found.jacobian,
            np.einsum("ni,nim->nm", found.normals, moved),
            scan.lines[found.index],
            len(found.index) / max(1, len(lines)),
        )

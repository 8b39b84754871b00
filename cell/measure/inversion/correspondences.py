"""A scan's points beside the nominal surface: how far off it they lie, with which uncertainty, and what the pose does.

Distances and normals are the model's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.poses import cross
from cell.measure.inversion.closest import Array
from cell.measure.inversion.nominal import NominalSurface
from cell.measure.reconstruction.cloud import Cloud

SIGMA_FLOOR = 3e-6
"""Smallest standard deviation of a point along a normal, m: what a tessellation leaves."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (n, 3) of a scan in the arm base, m.

    `stripe_spread` and `rail_spread` (n, 3) m: what one standard deviation of the stripe centre and of the rail moves
    each point by. The rail's error is common to the points with the same number in `lines` (n,).
    """

    points: Array
    stripe_spread: Array
    rail_spread: Array
    lines: NDArray[np.intp]

    @classmethod
    def of(cls, cloud: Cloud, most: int = 10_000) -> Scan:
        """At most `most` points, spread evenly over the cloud."""
        lines, rows = cloud.subsample(most)
        spread = cloud.stripe_spread[lines, rows].astype(np.float64)
        return cls(cloud.points[lines, rows], spread, cloud.rail_spread[lines], lines)

    def thinned(self, most: int) -> Scan:
        """At most `most` points, drawn evenly: a regular stride would fall into step with the rows of the cloud."""
        if len(self.points) <= most:
            return self
        k = np.sort(np.random.default_rng(0).permutation(len(self.points))[:most])
        return Scan(self.points[k], self.stripe_spread[k], self.rail_spread[k], self.lines[k])


@dataclass(frozen=True, eq=False)
class Rows:
    """Linearised correspondences: indices of the points, heights (m), normals, arms and Jacobian (n, 6)."""

    index: NDArray[np.intp]
    heights: Array
    normals: Array
    arms: Array
    jacobian: Array


def correspondences(pose: pin.SE3, scan: Scan, nominal: NominalSurface, gate: float) -> Rows:
    """Points within `gate` m of the surface and over it, with the derivative of their heights by the pose."""
    local = (scan.points - pose.translation) @ pose.rotation
    index, feet = nominal.feet(local, gate)
    keep = feet.inner & (np.abs(feet.heights) < gate)
    index = index[keep]
    normals = feet.normals[keep] @ pose.rotation.T
    arms = scan.points[index] - pose.translation
    jacobian = -np.concatenate([normals, cross(arms, normals)], axis=1)
    return Rows(index, feet.heights[keep], normals, arms, jacobian)


def sigmas_along(scan: Scan, rows: Rows) -> Array:
    """Standard deviations along the normals from the stripe's noise, m."""
    along = np.einsum("ni,ni->n", scan.stripe_spread[rows.index], rows.normals)
    return np.asarray(np.hypot(along, SIGMA_FLOOR))


def robust_scale(ratios: Array) -> float:
    """How many times larger the deviations are than their σ says, at least 1, from their median absolute value."""
    return max(1.0, float(np.median(np.abs(ratios))) / 0.6745) if len(ratios) else 1.0

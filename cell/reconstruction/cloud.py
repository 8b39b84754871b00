"""The organised cloud of one sweep: one line per frame, one place per image row, NaN where there is no point.

It keeps what each point's uncertainty needs, and the raw readings from which it can be solved again under another
calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a sweep in the arm base frame, organised as line × row.

    points: (lines, rows, 3) in m, NaN for holes and for rejected points.
    stripe_spread: (lines, rows, 3) float32, m in base axes: where one standard deviation of the stripe centre moves
        the point. The errors of different points are independent.
    rail_spread: (lines, 3), m in base axes: the same for the rail position of a line, common to its points.
    centres: (lines, rows) stripe centres in px, with rejected ones; rail: (lines,) rail positions in m.
    rejected: (lines, rows) True where a point was measured and rejected as an outlier.
    """

    points: Array
    stripe_spread: NDArray[np.float32]
    rail_spread: Array
    centres: Array
    rail: Array
    rejected: Mask

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and rows."""
        return self.points.shape[0], self.points.shape[1]

    @property
    def valid(self) -> Mask:
        """(lines, rows) True where there is a point."""
        return np.isfinite(self.points[:, :, 0])

    @property
    def size(self) -> int:
        """Number of points."""
        return int(np.count_nonzero(self.valid))

    def subsample(self, most: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices (line, row) of at most `most` points, spread evenly over the cloud."""
        lines, rows = np.nonzero(self.valid)
        if len(lines) <= most:
            return lines, rows
        # An irrational stride over the line-by-line order hits every line and row about equally often.
        keep = np.unique(np.floor(np.arange(most) * (len(lines) / most)).astype(np.intp))
        return lines[keep], rows[keep]

    def covariances(self, lines: NDArray[np.intp], rows: NDArray[np.intp]) -> Array:
        """Random part of the covariance (n, 3, 3) in m², base axes, of the points at (lines, rows)."""
        a = self.stripe_spread[lines, rows].astype(np.float64)
        b = self.rail_spread[lines]
        return np.asarray(a[:, :, None] * a[:, None, :] + b[:, :, None] * b[:, None, :])

    def sigma_along(self, lines: NDArray[np.intp], rows: NDArray[np.intp], directions: Array) -> Array:
        """Standard deviations (n,) in m of the points at (lines, rows) along unit `directions` (n, 3), base axes."""
        a = np.einsum("ni,ni->n", self.stripe_spread[lines, rows], directions)
        b = np.einsum("ni,ni->n", self.rail_spread[lines], directions)
        return np.asarray(np.hypot(a, b), dtype=np.float64)

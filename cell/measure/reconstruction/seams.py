"""How well several sweeps agree where they overlap: distances of one sweep's points from the other one's surface.

The figure at a seam holds all that a merged cloud leaves unseen within one sweep: the arm's repeatability, the
vehicle's lean, and calibration errors that two poses of the head do not share.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from cell.measure.reconstruction.cloud import Array, Cloud, Indices, Mask

Motions = Callable[[Indices, Indices], Array]

REACH = 0.0008
"""The other sweep must have a point within this distance, m, else it does not cover the place."""
MOST_POINTS = 3000
LEAST_POINTS = 50
FLAT = 0.0001
"""Neighbours that scatter more than this about their plane, m (rms), lie at an edge and say nothing."""


@dataclass(frozen=True)
class Seam:
    """Two sweeps where they overlap. Distances in m, of the points of `second` from the surface of `first`, along its
    normal: `mean`, `rms`, `p95` of the absolute values; `expected_mean` and `expected_rms` are one standard deviation
    of the mean and the rms to expect from the noise and from what the sweeps do not share; `points` compared."""

    first: int
    second: int
    points: int
    mean: float
    rms: float
    p95: float
    expected_mean: float
    expected_rms: float

    def as_dict(self) -> dict[str, object]:
        """For the journal and the report, in mm."""
        return {
            "sweeps": [self.first, self.second],
            "points": self.points,
            **{
                f"{name}_mm": round(1e3 * float(getattr(self, name)), 4)
                for name in ("mean", "rms", "p95", "expected_mean", "expected_rms")
            },
        }


def find_seams(cloud: Cloud, motions: Motions) -> list[Seam]:
    """Every pair of sweeps that overlap, and how far they lie apart there.

    `motions` gives, for points at (lines, rows), how one standard deviation of each independent systematic error moves
    them: (n, 3, m) in m, base axes, as `sensitivity` makes them. What moves both sweeps alike cancels.
    """
    parts = [_points(cloud, lines) for lines in cloud.each_sweep()]
    trees = [scipy.spatial.cKDTree(cloud.points[lines, rows]) for lines, rows in parts]
    found = []
    for a, b in itertools.combinations(range(len(parts)), 2):
        if min(len(parts[a][0]), len(parts[b][0])) < LEAST_POINTS:
            continue
        seam = _seam(cloud, (a, b), parts, trees[a], motions)
        if seam is not None:
            found.append(seam)
    return found


def _points(cloud: Cloud, lines: slice) -> tuple[Indices, Indices]:
    line, row = np.nonzero(cloud.valid[lines])
    return line + lines.start, row


def _seam(
    cloud: Cloud,
    pair: tuple[int, int],
    parts: list[tuple[Indices, Indices]],
    tree: scipy.spatial.cKDTree,
    motions: Motions,
) -> Seam | None:
    (lines_a, rows_a), (lines_b, rows_b) = parts[pair[0]], parts[pair[1]]
    near = tree.query(cloud.points[lines_b, rows_b], k=1, distance_upper_bound=REACH)[0] < REACH
    lines_b, rows_b = lines_b[near], rows_b[near]
    keep = np.unique(np.linspace(0, len(lines_b) - 1, min(MOST_POINTS, len(lines_b))).astype(np.intp))
    lines_b, rows_b = lines_b[keep], rows_b[keep]
    if len(lines_b) < LEAST_POINTS:
        return None
    nearest = np.asarray(tree.query(cloud.points[lines_b, rows_b], k=1)[1])
    beside, full = _around(cloud, cloud.each_sweep()[pair[0]], lines_a[nearest], rows_a[nearest])
    lines_b, rows_b, nearest = lines_b[full], rows_b[full], nearest[full]
    if len(lines_b) < LEAST_POINTS:
        return None
    own, around = cloud.points[lines_b, rows_b], cloud.points[beside[0], beside[1]]
    centre = around.mean(axis=1)
    spread, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around - centre[:, None], around - centre[:, None]))
    # A place at the rim of the other sweep has neighbours on one side only; there its plane would be continued.
    inside = np.linalg.norm(own - centre, axis=1) < REACH
    count = around.shape[1]
    good = inside & (spread[:, 0] / count < FLAT**2) & (spread[:, 1] > 9 * spread[:, 0])
    if good.sum() < LEAST_POINTS:
        return None
    normals, own, centre = vectors[good, :, 0], own[good], centre[good]
    normals = normals * np.sign(normals @ normals[0])[:, None]
    heights = np.einsum("ni,ni->n", own - centre, normals)
    noise = cloud.sigma_along(lines_b[good], rows_b[good], normals) ** 2
    for k in range(count):
        noise += cloud.sigma_along(beside[0][good, k], beside[1][good, k], normals) ** 2 / count**2
    first = nearest[good]
    apart = motions(lines_b[good], rows_b[good]) - motions(lines_a[first], rows_a[first])
    along = np.einsum("ni,nim->nm", normals, apart)
    return Seam(
        first=pair[0],
        second=pair[1],
        points=len(heights),
        mean=float(heights.mean()),
        rms=float(np.sqrt(np.mean(heights**2))),
        p95=float(np.percentile(np.abs(heights), 95)),
        expected_mean=float(np.sqrt(np.sum(along.mean(axis=0) ** 2) + noise.mean() / len(noise))),
        expected_rms=float(np.sqrt(np.mean(noise + np.sum(along**2, axis=1)))),
    )


def _around(cloud: Cloud, sweep: slice, lines: Indices, rows: Indices) -> tuple[tuple[Indices, Indices], Mask]:
    """Lines and rows (m, 15) of the points around those of one sweep at (n,) lines and rows, about as far across the
    lines as along them, and which of the n have all of them."""
    ways = [cloud.points[sweep.start + 1 : sweep.stop] - cloud.points[sweep.start : sweep.stop - 1]]
    ways.append(cloud.points[sweep, 1:] - cloud.points[sweep, :-1])
    across, along = (float(np.nanmedian(np.linalg.norm(way, axis=2))) for way in ways)
    stride = max(1, round(0.5 * across / along))
    steps = np.array([(i, j * stride) for i in (-1, 0, 1) for j in (-2, -1, 0, 1, 2)])
    line, row = lines[:, None] + steps[:, 0], rows[:, None] + steps[:, 1]
    there = (line >= sweep.start) & (line < sweep.stop) & (row >= 0) & (row < cloud.shape[1])
    line, row = np.where(there, line, sweep.start), np.where(there, row, 0)
    full = (there & cloud.valid[line, row]).all(axis=1)
    return (line[full], row[full]), full

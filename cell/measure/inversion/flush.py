"""Flush: how much higher than drawn a placed part stands over the surface beside its edge, in one sweep of both.

The part's pose says how it lies as a whole. Along its edge each piece is held against what lies beside that piece, so a
part or a surface that is bent shows, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import scipy

from cell.measure.inversion.disagreement import ROWS, SQUARE_M, STEEPEST, squares
from cell.measure.inversion.nominal import Array, Indices, NominalSurface
from cell.measure.reconstruction.cloud import Cloud

REACH_M = 3e-3
"""Farther from what is drawn a point belongs to something else."""
NOISY_M = 0.4e-3
"""A piece whose noise is more shows a wall, or several things."""
BESIDE_M = 6e-3
"""A piece of the edge is held against what lies nearer than this."""


@dataclass(frozen=True, eq=False)
class Flush:
    """Pieces of 2 mm along a part's edge: their middles `places` (n, 3) m, surface frame, how much `higher` (n,) m than
    drawn each stands over the surface beside it, along the surface's z axis, and four standard deviations, `noise`."""

    places: Array
    higher: Array
    noise: Array

    @property
    def span(self) -> str:
        """The least and the largest, mm, for people."""
        least, _, most = self._figures(2)
        return f"{least:+.2f} to {most:+.2f}"

    @property
    def beyond(self) -> float:
        """How far the worst piece is off what is drawn, up or down, beyond its noise, mm; below 0 within it."""
        return 1e3 * float(np.max(np.abs(self.higher) - self.noise))

    def as_dict(self) -> dict[str, float]:
        """For the journal."""
        least, middle, most = self._figures(4)
        return {"least_mm": least, "median_mm": middle, "largest_mm": most, "pieces": len(self.higher)}

    def _figures(self, digits: int) -> tuple[float, ...]:
        return tuple(round(1e3 * float(v), digits) + 0.0 for v in np.percentile(self.higher, [0, 50, 100]))


def flush_along_edge(
    cloud: Cloud, base_from_surface: pin.SE3, nominal: NominalSurface, faces: NominalSurface, belongs: pin.SE3
) -> Flush | None:
    """The flush of a part with these `faces`, which `belongs` at surface_from_part, in a sweep over it and beside it.

    `cloud` is in the arm base, where the same sweep shows the surface at `base_from_surface`. None where no piece of
    the edge has some of the surface beside it.
    """
    lines, rows = np.nonzero(cloud.valid)
    local = (cloud.points[lines, rows] - base_from_surface.translation) @ base_from_surface.rotation
    part = _standing((local - belongs.translation) @ belongs.rotation, local, lines, faces)
    beside = _standing(local, local, lines, nominal)
    if part is None or beside is None:
        return None
    nearest, other = map(np.asarray, scipy.spatial.cKDTree(beside.places[:, :2]).query(part.places[:, :2]))
    edge = nearest <= BESIDE_M
    if not edge.any():
        return None
    higher, noise = beside.higher[other[edge]], beside.noise[other[edge]]
    return Flush(part.places[edge], part.higher[edge] - higher, np.hypot(part.noise[edge], noise))


def _standing(points: Array, places: Array, lines: Indices, drawn: NominalSurface) -> Flush | None:
    """How much higher than `drawn` its points stand, in squares of 2 mm; None where no square has points enough.

    `points` (n, 3) are in the frame of what is drawn, `places` (n, 3) the same in the surface's.
    """
    index, feet = drawn.feet(points, REACH_M)
    up = feet.normals[:, 2]
    kept = feet.inner & (up > STEEPEST)
    if not kept.any():
        return None
    index = index[kept]
    column, row = np.floor(places[index, :2] / SQUARE_M).astype(np.intp).T
    square = np.asarray(column * 2 * ROWS + row)
    medians, higher, noise = squares(square, feet.heights[kept] / up[kept], lines[index])
    clear = noise <= NOISY_M
    return Flush(places[index[medians[clear]]], higher[clear], noise[clear]) if clear.any() else None

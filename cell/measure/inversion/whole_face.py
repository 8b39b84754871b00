"""Is all of a placed part's face there, and bare? A corner that broke off, a face that was cut away, a nut left on it.

A robust fit finds a part by what is left of it, and passes over the rest. Where the sweep sees far below the drawn
face, that is not there; where it sees nothing but what stands far above, something lies on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.inversion.disagreement import ROWS, SQUARE_M, square_of
from cell.measure.inversion.nominal import Array, Indices, NominalSurface
from cell.measure.reconstruction.cloud import Cloud

FAR_M = 1.5e-3
"""Points so far below or above all that is drawn in a square are not of it."""
LEAST_POINTS = 3
"""Such points that a square needs, with none of the face itself."""
MOST_UNLIKE = 3 * SQUARE_M**2
"""So much of a face, m², may be a reflection."""
BESIDE = np.array([0, 1, -1, 2 * ROWS, -2 * ROWS, 2 * ROWS + 1, 2 * ROWS - 1, -2 * ROWS + 1, -2 * ROWS - 1])
"""From the number of a square to those of itself and the eight about it."""


@dataclass(frozen=True, eq=False)
class FacePatch:
    """So much of a face, `area` m², about `at` (3,) m, part frame, is `gone`; else something stands on it."""

    area: float
    at: Array
    gone: bool

    @property
    def words(self) -> str:
        """For people."""
        x, y, z = 1e3 * self.at
        what = "is not there" if self.gone else "is covered: something stands on it"
        return f"{1e6 * self.area:.0f} mm² of its face about ({x:.0f}, {y:.0f}, {z:.0f}) mm in its own frame {what}"

    def as_dict(self) -> dict[str, object]:
        """For the report."""
        return {
            "mm2": round(1e6 * self.area, 1), "at_mm": [round(1e3 * float(v), 1) for v in self.at], "gone": self.gone,
        }  # fmt: skip


def unlike_patch(cloud: Cloud, base_from_surface: pin.SE3, lies: pin.SE3, faces: NominalSurface) -> FacePatch | None:
    """The largest of what is gone and what is covered of a part with these `faces`, which `lies` at surface_from_part,
    by the cloud of a sweep over it, arm base. None where all that is seen of it is there, and bare.

    A square of 2 mm counts that is drawn together with the eight about it: rims are for the part's named edges.
    """
    upward = lies.rotation.T[:, 2]
    drawn, low, high = _drawn_heights(faces, lies, upward)
    inside = np.logical_and.reduce(np.isin(drawn[:, None] + BESIDE, drawn), axis=1)
    base_from_part = base_from_surface * lies
    places = (cloud.points[cloud.valid] - base_from_part.translation) @ base_from_part.rotation
    square = square_of(places @ lies.rotation.T)
    at = np.minimum(np.searchsorted(drawn, square), len(drawn) - 1)
    known = (drawn[at] == square) & inside[at]
    at, up = at[known], (places @ upward)[known]
    below, above = up < low[at] - FAR_M, up > high[at] + FAR_M
    own = np.bincount(at[~below & ~above], minlength=len(drawn))
    patches = []
    for far, gone in ((below, True), (above, False)):
        found = np.flatnonzero((np.bincount(at[far], minlength=len(drawn)) >= LEAST_POINTS) & (own == 0))
        if len(found) * SQUARE_M**2 > 1.01 * MOST_UNLIKE:
            middle = np.median(_middles(drawn[found], high[found]), axis=0) @ lies.rotation
            patches.append(FacePatch(len(found) * SQUARE_M**2, middle, gone))
    return max(patches, key=lambda patch: patch.area, default=None)


def _drawn_heights(faces: NominalSurface, lies: pin.SE3, upward: Array) -> tuple[Indices, Array, Array]:
    """The squares in which the faces are drawn, in order, and from where to where they go up in each, m."""
    square = square_of(faces.samples @ lies.rotation.T)
    drawn, owner = np.unique(square, return_inverse=True)
    up = faces.samples @ upward
    low, high = np.full(len(drawn), np.inf), np.full(len(drawn), -np.inf)
    np.minimum.at(low, owner, up)
    np.maximum.at(high, owner, up)
    return drawn, low, high


def _middles(square: NDArray[np.intp], up: Array) -> Array:
    """The middles (n, 3) m of squares by their numbers, as high as told."""
    row = (square + ROWS) % (2 * ROWS) - ROWS
    column = (square - row) // (2 * ROWS)
    return np.column_stack([SQUARE_M * (column + 0.5), SQUARE_M * (row + 0.5), up])

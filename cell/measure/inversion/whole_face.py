"""Is all of a placed part's face there, and bare? A corner that broke off, a face that was cut away, a nut left on it.

A robust fit finds a part by what is left of it, and passes over the rest. Where the sweep sees far below the drawn
face, that is not there; where it sees nothing but what stands far above, something lies on it.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import scipy.ndimage
from numpy.typing import NDArray

from cell.measure.inversion.disagreement import SQUARE_M
from cell.measure.inversion.nominal import Array, Indices, NominalSurface
from cell.measure.reconstruction.cloud import Cloud

FAR_M = 1.5e-3
"""Points so far below or above all that is drawn in a square are not of it."""
LEAST_POINTS = 3
"""Such points that a square needs, with none of the face itself."""
MOST_UNLIKE = 3 * SQUARE_M**2
"""So much of a face in one piece, m², may be a reflection."""
SAMPLES, MOST_SAMPLES = 32, 3_000_000
"""Of the drawn faces for each square, and at most in all: above a third of a square metre they lie farther apart."""
DRAWN = 0.5
"""Share of its samples from which on a square counts as drawn: one that a slot leaves a sliver of does not."""
ALL_ABOUT = np.ones((3, 3), dtype=np.bool_)


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
    drawn = _samples(faces) @ lies.rotation.T
    corner = np.floor(drawn[:, :2].min(axis=0) / SQUARE_M).astype(np.intp) - 1
    shape = np.floor(drawn[:, :2].max(axis=0) / SQUARE_M).astype(np.intp) - corner + 2
    low, high, inside = _drawn_heights(drawn, corner, shape)
    base_from_part = base_from_surface * lies
    places = (cloud.points[cloud.valid] - base_from_part.translation) @ base_from_part.rotation @ lies.rotation.T
    column, row = (np.floor(places[:, :2] / SQUARE_M).astype(np.intp) - corner).T
    near = (column >= 0) & (row >= 0) & (column < shape[0]) & (row < shape[1])
    column, row, up = column[near], row[near], places[near, 2]
    below, above = up < low[column, row] - FAR_M, up > high[column, row] + FAR_M

    def counted(which: NDArray[np.bool_]) -> Indices:
        found = np.zeros(tuple(shape), dtype=np.intp)
        np.add.at(found, (column[which], row[which]), 1)
        return found

    bare = inside & (counted(~below & ~above) == 0)
    patches = []
    for far, gone in ((below, True), (above, False)):
        pieces, number = scipy.ndimage.label(bare & (counted(far) >= LEAST_POINTS), ALL_ABOUT)
        sizes = np.bincount(pieces.ravel(), minlength=number + 1)[1:]
        if number and sizes.max() * SQUARE_M**2 > 1.01 * MOST_UNLIKE:
            squares = np.argwhere(pieces == 1 + int(sizes.argmax()))
            middle = np.append(SQUARE_M * (squares.mean(axis=0) + corner + 0.5), np.median(high[tuple(squares.T)]))
            patches.append(FacePatch(len(squares) * SQUARE_M**2, middle @ lies.rotation, gone))
    return max(patches, key=lambda patch: patch.area, default=None)


def _drawn_heights(drawn: Array, corner: Indices, shape: Indices) -> tuple[Array, Array, NDArray[np.bool_]]:
    """From where to where, m, the samples (n, 3) go up in each square, and which squares are drawn with all about."""
    column, row = (np.floor(drawn[:, :2] / SQUARE_M).astype(np.intp) - corner).T
    low: Array = np.full(tuple(shape), np.inf)
    high: Array = np.full(tuple(shape), -np.inf)
    count = np.zeros(tuple(shape), dtype=np.intp)
    np.minimum.at(low, (column, row), drawn[:, 2])
    np.maximum.at(high, (column, row), drawn[:, 2])
    np.add.at(count, (column, row), 1)
    usual = np.median(count[count > 0])
    return low, high, np.asarray(scipy.ndimage.binary_erosion(count >= DRAWN * usual, ALL_ABOUT))


def _samples(faces: NominalSurface) -> Array:
    """Points (n, 3) of the faces, part frame, as dense everywhere, whatever their triangles are like."""
    number = min(MOST_SAMPLES, max(1, round(SAMPLES * float(faces.areas.sum()) / SQUARE_M**2)))
    until = np.cumsum(faces.areas)
    owner = np.searchsorted(until, (np.arange(number) + 0.5) / number * until[-1])
    # A sequence that fills each triangle evenly (Roberts, 2018), folded from the square onto it.
    along, across = np.mod(np.outer([0.7548776662466927, 0.5698402909980532], np.arange(1, number + 1)), 1.0)
    folded = along + across > 1.0
    along, across = np.where(folded, 1.0 - along, along), np.where(folded, 1.0 - across, across)
    a, b, c = (faces.vertices[faces.triangles[owner, k]] for k in range(3))
    return np.asarray(a + along[:, None] * (b - a) + across[:, None] * (c - a))

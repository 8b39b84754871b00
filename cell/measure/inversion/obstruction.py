"""What stands on the place, as the scan saw it: a chip, a burr, a screw that was left there.

The place is told by most of the surface, and a robust fit passes over the few points that do not belong to it. The part
does not: it comes to lie on the highest of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.measure.inversion.closest import Array, Indices
from cell.measure.inversion.nominal import NominalSurface
from cell.measure.reconstruction.cloud import Cloud
from drivers.errors import Measured, RefusedError

REACH_M = 6e-3
"""What stands higher is felt on the way down."""
SQUARE_M, LEAST_POINTS, LEAST_LINES = 2e-3, 8, 2
"""Squares over which heights are taken together, and what one needs to count: a single line may be a reflection."""
ROWS = 100_000
"""More than a part has of them to either side."""
STEEPEST = 0.5
"""Cosine of the slope beyond which a height along the normal is one to the side."""
SIGMAS = 4.0
"""Of a square's own noise, by which it has to be the higher."""
ALLOWED = 0.5
"""Share of the place's tolerance that a part may be lifted by: what else it may be off by has the rest."""


@dataclass(frozen=True, eq=False)
class Standing:
    """The highest square: it would lift a part by `height`, m, at least; its middle at `at` (3,), m, surface frame."""

    height: float
    at: Array


def highest_standing(
    cloud: Cloud, nominal: NominalSurface, pose: pin.SE3, surface_from_part: pin.SE3, size: Sequence[float]
) -> Standing | None:
    """What stands highest on the surface at `pose` (base_from_surface) below a part of this `size`, m, beyond noise.

    The part lies at `surface_from_part`, its mating face up to half of its size about its origin. None where no square
    has points enough.
    """
    lines, rows = np.nonzero(cloud.valid)
    local = (cloud.points[lines, rows] - pose.translation) @ pose.rotation
    index, feet = nominal.feet(local, REACH_M)
    below = (feet.points - surface_from_part.translation) @ surface_from_part.rotation
    up = feet.normals @ surface_from_part.rotation[:, 2]
    kept = feet.inner & (up > STEEPEST) & (np.abs(below[:, :2]) <= 0.5 * np.asarray(size)[:2]).all(axis=1)
    if not kept.any():
        return None
    line, lift, below = lines[index[kept]], (feet.heights / up)[kept], below[kept]
    places = local[index[kept]]
    found = None
    # Squares that overlap by half: in some of them a small thing is in the middle.
    for shift in np.ndindex(2, 2):
        column, row = np.floor(below[:, :2] / SQUARE_M + 0.5 * np.array(shift)).astype(np.intp).T
        square = column * 2 * ROWS + row
        if (highest := _highest(square, lift, line)) is not None and (found is None or highest[1] > found.height):
            found = Standing(highest[1], places[highest[0]])
    return found


def _highest(square: Indices, lift: Array, line: Indices) -> tuple[int, float] | None:
    """Of the squares (n,) with points enough the highest: the point of its median, and its height less noise.

    None where no square has enough.
    """
    _, owner = np.unique(square, return_inverse=True)
    count = np.bincount(owner)
    medians, middle = _medians(owner, lift, count)
    # Points of one line share most of their noise.
    each = int(line.max()) + 1
    taken = np.bincount(np.unique(owner * each + line) // each)
    _, spread = _medians(owner, np.abs(lift - middle[owner]), count)
    height = middle - SIGMAS * 1.4826 * spread / np.sqrt(taken)
    enough = np.flatnonzero((count >= LEAST_POINTS) & (taken >= LEAST_LINES))
    if not len(enough):
        return None
    best = enough[np.argmax(height[enough])]
    return int(medians[best]), float(height[best])


def _medians(owner: Indices, values: Array, count: Indices) -> tuple[Indices, Array]:
    """Of each owner's values the middle one, and where it is."""
    order = np.lexsort((values, owner))
    middle = order[np.cumsum(count) - count + count // 2]
    return middle, values[middle]


def require_bare(found: Standing | None, tolerance: float) -> None:
    """Raise `RefusedError` for a place, of this `tolerance` in m, on which something stands that lifts the part."""
    allowed = ALLOWED * tolerance
    if found is None or found.height <= allowed:
        return
    x, y, z = 1e3 * found.at
    raise RefusedError(
        f"something stands {1e3 * found.height:.2f} mm out of the surface at ({x:.0f}, {y:.0f}, {z:.0f}) mm, as the "
        f"scan saw it: the part would come to lie on it. Allowed are {1e3 * allowed:.2f} mm, half of the place's "
        "tolerance. Look what it is (a chip, a burr, a drop), then run the job again from its sweep",
        Measured("stands out of the surface", 1e3 * found.height, "mm", most=1e3 * allowed),
    )

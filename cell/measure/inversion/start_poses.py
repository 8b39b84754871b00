"""Where the registration may begin: poses across the surface at which the scan lies near it.

A placement surface slides and turns onto a wrong place most easily within its own mean plane. The prior leaves a range
of such shifts and turns; all of them are tried against the coarse distance field, and the best, well apart, returned.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.base.compiled import compiled_fast
from cell.measure.inversion.closest import Array
from cell.measure.inversion.nominal import NominalSurface

REACH = 0.0015
"""Distance from which on a point counts nothing, m."""
STEP = 0.001
"""Distance between the shifts that are tried, and of the rim between the turns, m."""
MOST_SHIFT, MOST_TURN = 0.010, float(np.radians(28.0))
WORTH = 0.75
"""Share of the best candidate's score that another needs to be looked at."""


def across(nominal: NominalSurface) -> tuple[Array, Array]:
    """Unit mean normal (3,) of the surface and two axes (2, 3) across it, surface frame."""
    normal = np.average(nominal.normals, axis=0, weights=nominal.areas)
    if np.linalg.norm(normal) < 0.1:  # a closed body has no mean normal
        normal = np.array([0.0, 0.0, 1.0])
    normal = normal / np.linalg.norm(normal)
    return normal, np.asarray(np.linalg.svd(normal[None])[2][1:])


def candidates(
    level: pin.SE3, points: Array, nominal: NominalSurface, shift: float, turn: float, most: int
) -> list[pin.SE3]:
    """At most `most` poses base_from_surface, best first, within `shift` m across and `turn` rad about the mean normal
    of `level`, at which many of `points` (n, 3), arm base, lie near the surface.
    """
    normal, sides = across(nominal)
    shift, turn = min(shift, MOST_SHIFT), min(turn, MOST_TURN)
    n_shift = int(np.ceil(shift / STEP))
    n_turn = int(np.ceil(turn * nominal.radius / (1.5 * STEP)))
    steps: Array = STEP * np.arange(-n_shift, n_shift + 1, dtype=np.float64)
    angles: Array = (turn / max(1, n_turn)) * np.arange(-n_turn, n_turn + 1, dtype=np.float64)
    local = (points - level.translation) @ level.rotation - nominal.centre
    turns = np.stack([pin.exp3(-angle * normal) for angle in angles])
    grid = nominal.grid
    offset = nominal.centre - grid.low
    scores = _scores(local, turns, steps, sides=sides, offset=offset, cell=grid.cell, distance=grid.distance)
    poses: list[pin.SE3] = []
    best = float(scores.max())
    while len(poses) < most and scores.max() > max(0.0, WORTH * best):
        k, i, j = (int(v) for v in np.unravel_index(np.argmax(scores), scores.shape))
        scores[max(0, k - 2) : k + 3, max(0, i - 3) : i + 4, max(0, j - 3) : j + 4] = -1.0
        moved = pin.SE3(pin.exp3(angles[k] * normal), steps[i] * sides[0] + steps[j] * sides[1])
        pivot = pin.SE3(np.eye(3), nominal.centre)
        poses.append(level * pivot * moved * pivot.inverse())
    return poses


@compiled_fast
def _scores(
    points: Array, turns: Array, steps: Array, sides: Array, offset: Array, cell: float, distance: NDArray[np.float32]
) -> Array:
    """Sum of 1 − (distance/REACH)² over the points that lie within REACH, for each (turn, shift, shift)."""
    scores = np.zeros((len(turns), len(steps), len(steps)))
    a, b, c = distance.shape
    turned = np.empty((len(points), 3))
    shifted = np.empty((2, 3))
    for k in range(len(turns)):
        # In cells: each shift then moves the turned points along the turned axes.
        r = turns[k]
        for i in range(3):
            for n in range(len(points)):
                along = r[i, 0] * points[n, 0] + r[i, 1] * points[n, 1] + r[i, 2] * points[n, 2]
                turned[n, i] = (along + offset[i]) / cell
            for side in range(2):
                along = r[i, 0] * sides[side, 0] + r[i, 1] * sides[side, 1] + r[i, 2] * sides[side, 2]
                shifted[side, i] = along / cell
        for i in range(len(steps)):
            for j in range(len(steps)):
                s0 = steps[i] * shifted[0, 0] + steps[j] * shifted[1, 0]
                s1 = steps[i] * shifted[0, 1] + steps[j] * shifted[1, 1]
                s2 = steps[i] * shifted[0, 2] + steps[j] * shifted[1, 2]
                total = 0.0
                for n in range(len(points)):
                    x, y, z = turned[n, 0] - s0, turned[n, 1] - s1, turned[n, 2] - s2
                    if x >= 0 and y >= 0 and z >= 0 and x < a and y < b and z < c:
                        d = distance[int(x), int(y), int(z)]
                        if d < REACH:
                            total += 1.0 - (d / REACH) ** 2
                scores[k, i, j] = total
    return scores

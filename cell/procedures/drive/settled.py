"""Whether the vehicle stands quietly: photographs of the board that follow each other show it in one place, or do not.

A vehicle that has just stopped, or that somebody leans on, rocks on its tyres by a tenth of a milliradian and more, a
few times a second. The arm's base rocks with it, and what was seen a moment ago is not where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
import pinocchio as pin
import scipy

from cell.measure.inversion.effects.during_sweep import require_firm
from cell.measure.vision import BoardView
from drivers.interfaces import Vector

APART_S = 0.07
"""Between two photographs: four of them are spread over the period of the few hertz at which vehicles rock."""
CHANCE = 1e-5
"""Of taking a board that stands still for one that does not."""
LEAST_M = 20e-6
"""What a board goes to and fro less than this is not worth waiting for."""


def swing(views: Sequence[BoardView], metres_per_px: float) -> float:
    """By how much, m, to either side the board moves between photographs from one place; 0 where nothing shows it.

    The mean place of the points that all of them show tells it: what lens and board are off by is the same in each.
    """
    if len(views) < 2:
        return 0.0
    shared = reduce(np.intersect1d, [view.ids for view in views])
    if not len(shared):
        return 0.0
    means, variances = [], []
    for view in views:
        here = np.isin(view.ids, shared)
        means.append(view.pixels[here].mean(axis=0))
        variances.append(float(np.mean(view.sigma[here] ** 2)) / len(shared))
    squares = float(np.sum((np.array(means) - np.mean(means, axis=0)) ** 2))
    free = len(views) - 1
    if squares < float(np.mean(variances)) * scipy.special.chdtri(2 * free, CHANCE):
        return 0.0
    # Of a sine along a line the mean square is half that of its height.
    found = float(np.sqrt(2.0 * squares / free)) * metres_per_px
    return found if found > LEAST_M else 0.0


def swing_covariance(swung: float, base_from_board: pin.SE3, base_from_vehicle: pin.SE3) -> Vector:
    """Covariance (6, 6), m² and rad², base axes, of a board that goes to and fro by `swung` m as the vehicle rocks.

    Raises `RefusedError` when it rocks too much to put anything down.
    """
    away = float(np.linalg.norm(base_from_board.translation - base_from_vehicle.translation))
    angle = swung / away
    require_firm(angle, swung, "the board")
    return np.diag([0.5 * swung**2] * 3 + [0.5 * angle**2] * 3)


def words(swung: float, waited: float) -> str:
    """For people, where the job goes on nevertheless."""
    return (
        f"the vehicle rocks, or the board swings: after {waited:.0f} s of waiting it still goes to and fro by "
        f"±{1e3 * swung:.2f} mm between photographs; what that leaves open is in the stated uncertainty. See what "
        "shakes it, or lower the vehicle's supports"
    )

"""A parameter that the joint adjustment does not have: what it would be, beside all that it has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cell.measure.calibration.solve.adjustment import Adjustment
from cell.measure.calibration.solve.blocks import SHARED, AdjustmentState
from cell.measure.geometry.camera import Array

DAMPING = 1e-9
LEAST_LEFT = 1e-9
"""Share of its information below which the other parameters can take all of it."""


@dataclass(frozen=True, eq=False)
class OneMore:
    """Its `value` at the minimum, the `information` on it that is left (one over its variance), `gain` (27,) of others.

    The `gain` is by how much the shared parameters follow it, per unit of it. Without any information the value is 0.
    """

    value: float
    information: float
    gain: Array

    @property
    def sigma(self) -> float:
        """One standard deviation; infinite without information."""
        return 1.0 / float(np.sqrt(self.information)) if self.information > 0 else np.inf


def one_more(problem: Adjustment, state: AdjustmentState, group: str, column: Callable[[int, Array], Array]) -> OneMore:
    """Asked of the normal equations at a minimum `state`, with all else left free to take its part of it.

    `column` gives, of a view's number and the whitened rows (m, 34) of its `group`, the rows' derivatives (m,) by the
    new parameter.
    """
    normal = problem.normal_at(state)
    right, right_own = np.zeros(SHARED), np.zeros_like(normal.right_own)
    information, slope = 0.0, 0.0
    for k in range(len(problem.views)):
        for name, rows, residual, _ in problem.rows_of(k, state):
            if name != group:
                continue
            by_it = column(k, rows)
            information += float(by_it @ by_it)
            slope += float(by_it @ residual)
            mixed = by_it @ rows
            right += mixed[:SHARED]
            right_own[k] += mixed[SHARED:]
    normal.right, normal.right_own = right, right_own
    whole = np.concatenate([right, right_own.ravel()])
    follow = -normal.step(DAMPING)
    left = information + float(whole @ follow)
    # What is left by the damping alone grows with it.
    damped = information - float(whole @ normal.step(10.0 * DAMPING))
    if not left > LEAST_LEFT * information or damped > 2.0 * left:
        return OneMore(0.0, 0.0, np.zeros(SHARED))
    return OneMore(slope / left, left, follow[:SHARED])

"""The bow of the light sheet: one more parameter of the adjustment, kept only where the stripes ask for it.

docs/explanation/theory.md, section 6.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cell.measure.calibration.solve.adjustment import Adjusted, Adjustment
from cell.measure.calibration.solve.normal import SHARED, AdjustmentState
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


EVIDENCE = 5.0
"""A bow of less than so many standard deviations is taken for noise: what it could do is less than they are."""
ROUNDS = 4
SHOWN_AT = (0.018, 0.130)
"""People are told the bow at this place, m: beside the sheet's middle, and in depth."""


@dataclass(frozen=True, eq=False)
class Bow:
    """The sheet's bow (see `LightPlane`), one standard deviation of it, and how far (n,) the other shared parameters of
    the adjustment follow it, per unit of it. A sigma of 0: the sheet is taken as flat."""

    value: float
    sigma: float
    gain: Array

    @property
    def words(self) -> str:
        """For people."""
        beside, depth = SHOWN_AT
        off, sigma = (1e3 * size * beside**2 / depth for size in (self.value, self.sigma))
        return (
            f"the light sheet is bowed: {1e3 * beside:g} mm beside its middle it is {off:+.4f} mm ± {sigma:.4f} mm off "
            "its plane; the measurements allow for it"
        )


FLAT = Bow(0.0, 0.0, np.zeros(SHARED))


def with_bow(problem: Adjustment, flat: Adjusted) -> Adjusted:
    """The adjustment with its bow, if the stripes show one; otherwise `flat` itself. The covariance is then that of the
    shared parameters with the bow unknown beside them."""
    if flat.state.plane is None:
        return flat
    found = flat
    more = _asked(problem, found.state)
    if not abs(more.value) > EVIDENCE * more.sigma:
        return flat
    for _ in range(ROUNDS):
        assert found.state.plane is not None
        plane = found.state.plane.bowed(found.state.plane.bow + more.value)
        found = problem.solve(replace(found.state, plane=plane))
        more = _asked(problem, found.state)
        if abs(more.value) < 0.1 * more.sigma:
            break
    assert found.state.plane is not None
    bow = Bow(found.state.plane.bow, more.sigma, more.gain)
    covariance = found.covariance + more.sigma**2 * np.outer(more.gain, more.gain)
    return replace(found, covariance=covariance, bow=bow)


def _asked(problem: Adjustment, state: AdjustmentState) -> OneMore:
    """By how much more the sheet seems bowed at a minimum."""
    plane = state.plane
    assert plane is not None

    def by_bow(k: int, rows: Array) -> Array:
        # A bow moves a point as the plane's distance does, by the bow's shape there.
        points = plane.intersect(state.camera.rays(problem.views[k].stripe))
        return np.asarray(rows[:, 11] * plane.shape(points))

    return one_more(problem, state, "stripe", by_bow)

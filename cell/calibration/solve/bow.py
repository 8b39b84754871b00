"""The bow of the light sheet: found beside everything else of the joint adjustment, and only where the stripes show it.

A flat sheet is the rule. Whether it is bowed is asked of the adjustment's normal equations: what the stripes' residuals
say of a bow, with all that other parameters can take of it left to them. docs/theory.md, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.calibration.solve.adjustment import Adjusted, Adjustment, huber
from cell.calibration.solve.blocks import SHARED, State, stripe_block
from cell.geometry.camera import Array

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
    """The adjustment with its bow, if the stripes show one; otherwise `flat` itself.

    The covariance is then that of the shared parameters with the bow unknown beside them.
    """
    if flat.state.plane is None:
        return flat
    found = flat
    change, sigma, gain = _asked(problem, found.state)
    if not abs(change) > EVIDENCE * sigma:
        return flat
    for _ in range(ROUNDS):
        assert found.state.plane is not None
        plane = found.state.plane.bowed(found.state.plane.bow + change)
        found = problem.solve(replace(found.state, plane=plane))
        change, sigma, gain = _asked(problem, found.state)
        if abs(change) < 0.1 * sigma:
            break
    assert found.state.plane is not None
    bow = Bow(found.state.plane.bow, sigma, gain)
    covariance = found.covariance + sigma**2 * np.outer(gain, gain)
    return replace(found, covariance=covariance, bow=bow)


def _asked(problem: Adjustment, state: State) -> tuple[float, float, Array]:
    """By how much more the sheet seems bowed at a minimum, its standard deviation, and how the shared parameters (27,)
    follow."""
    normal = problem.normal_at(state)
    normal.right[:], normal.right_own[:] = 0.0, 0.0
    information, slope = 0.0, 0.0
    for k, (view, flange, rail) in enumerate(zip(problem.views, state.flanges, state.rails, strict=True)):
        if not len(view.stripe):
            continue
        assert state.plane is not None
        residual, jacobian, sigma = stripe_block(state, view, flange, float(rail))
        sigma = problem.priors.stripe_scale * sigma
        weight, _ = huber(np.abs(residual / sigma))
        root = np.sqrt(weight) / sigma
        # A bow moves a point as the plane's distance does, by the bow's shape there.
        points = state.plane.intersect(state.camera.rays(view.stripe))
        by_bow = jacobian[:, 11] * state.plane.shape(points) * root
        information += float(by_bow @ by_bow)
        slope += float(by_bow @ (residual * root))
        mixed = by_bow @ (jacobian * root[:, None])
        normal.right += mixed[:SHARED]
        normal.right_own[k] += mixed[SHARED:]
    right = np.concatenate([normal.right, normal.right_own.ravel()])
    follow = -normal.step(1e-9)
    left = information + float(right @ follow)
    if not left > 1e-9 * information:
        return 0.0, np.inf, np.zeros(SHARED)
    return slope / left, 1.0 / float(np.sqrt(left)), follow[:SHARED]

"""The Cramér–Rao bound of a scan head's calibration: Fisher information of the generator itself, differentiated.

No derivative of the estimator is used. What the bound means for measured points is found by drawing from it, and what
the best calibration makes of the very noise that was drawn is its linear estimate: so luck is told from loss.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from cell.measure.calibration.archive import ScanObservation
from lab.bench.calibration.world import OWN, SHARED, Array, HeadWorld, Noise, seen_dots, seen_rows

STEPS = np.array(
    [1e-2, 1e-2, 1e-2, 1e-2, 1e-4, 1e-3, 1e-5, 1e-5] + [1e-4] * 3 + [1e-5] * 3 + [1e-6] * 12  # lens, plane, rail, poses
)
DRAWS = 200


@dataclass(frozen=True, eq=False)
class Bound:
    """Covariance (26, 26) that no unbiased calibration of this head under this noise can be below.

    `error` (26,) is what the best calibration, one that attains the bound, makes of the observations that were given.
    """

    covariance: Array
    error: Array = field(default_factory=lambda: np.zeros(SHARED))

    def draws(self, rng: np.random.Generator) -> Array:
        """Errors (200, 26) of the shared parameters as the best calibration would make them."""
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-30))
        values, vectors = np.linalg.eigh(self.covariance / scale[:, None] / scale)
        return np.asarray(rng.standard_normal((DRAWS, SHARED)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T * scale)


def cramer_rao(world: HeadWorld, noise: Noise, observations: Sequence[ScanObservation] | None = None) -> Bound:
    """The bound; poses of the flange and positions of the rail are unknowns that are read with their noise.

    With `observations`, one of each view, the bound is that of the dots that they hold, and has their best error.
    """
    total, score = np.zeros((SHARED, SHARED)), np.zeros(SHARED)
    prior = np.diag(1 / noise.own**2)
    nothing = np.zeros(OWN)
    views = range(len(world.rails))
    ids = [seen_dots(world.dots(view, nothing)) for view in views]
    rows = [np.flatnonzero(seen_rows(world, view, nothing)[1]) for view in views]
    if observations is not None:
        ids = [o.view.ids for o in observations if o.view is not None]
        rows = [
            row[np.isfinite(o.profile.centres[row])]
            for row, o in zip(rows, observations, strict=True)
            if o.profile is not None
        ]

    def predicted(there: HeadWorld, view: int, own: Array) -> Array:
        dots = there.dots(view, own)[ids[view]] / noise.dots
        return np.concatenate([dots.ravel(), there.stripe(view, own, rows[view].astype(float))[0] / noise.stripe])

    pairs = [(world.moved(step), world.moved(-step)) for step in np.diag(STEPS)]
    for view in views:
        shared = [
            (predicted(more, view, nothing) - predicted(less, view, nothing)) / (2 * size)
            for (more, less), size in zip(pairs, STEPS, strict=True)
        ]
        here = np.column_stack(shared)
        mine = differentiated(lambda own, view=view: predicted(world, view, own), np.full(OWN, 1e-6))  # type: ignore[misc]
        left = np.linalg.solve(mine.T @ mine + prior, mine.T)
        total += here.T @ here - here.T @ mine @ (left @ here)
        if observations is not None:
            off = _measured(observations[view], noise, rows[view]) - predicted(
                world, view, _as_read(world, view, observations[view])
            )
            score += here.T @ off - here.T @ mine @ (left @ off)
    scale = 1 / np.sqrt(np.diag(total))
    covariance = np.linalg.inv(total * scale[:, None] * scale) * scale[:, None] * scale
    covariance = 0.5 * (covariance + covariance.T)
    return Bound(covariance, covariance @ score)


def _measured(
    observation: ScanObservation, noise: Noise, rows: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
) -> Array:
    """Dots and stripe of an observation, whitened, in the order of the prediction."""
    assert observation.view is not None and observation.profile is not None
    stripe = observation.profile.centres[rows] / noise.stripe
    return np.concatenate([observation.view.pixels.ravel() / noise.dots, stripe])


def _as_read(world: HeadWorld, view: int, observation: ScanObservation) -> Array:
    """A view's own parameters (7,) when flange and rail are where they are said to be."""
    own = np.zeros(OWN)
    own[6] = observation.rail_position - world.rails[view]
    return own


def differentiated(function: Callable[[Array], Array], steps: Array) -> Array:
    """Jacobian (m, n) at zero of a function of n arguments, by central differences of the given steps (n,)."""
    columns = []
    for k, size in enumerate(steps):
        step = np.zeros(len(steps))
        step[k] = size
        columns.append((function(step) - function(-step)) / (2 * size))
    return np.column_stack(columns)

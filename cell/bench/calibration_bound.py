"""The Cramér–Rao bound of a scan head's calibration: Fisher information of the generator itself, differentiated.

No derivative of the estimator is used. What the bound means for measured points is found by drawing from it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cell.bench.calibration_world import OWN, SHARED, Array, HeadWorld, Noise, seen_dots, seen_rows

STEPS = np.array(
    [1e-2, 1e-2, 1e-2, 1e-2, 1e-4, 1e-3, 1e-5, 1e-5] + [1e-4] * 3 + [1e-5] * 3 + [1e-6] * 12  # lens, plane, rail, poses
)
DRAWS = 200


@dataclass(frozen=True, eq=False)
class Bound:
    """Covariance (26, 26) that no unbiased calibration of this head under this noise can be below."""

    covariance: Array

    def with_known(self, parameters: Sequence[int]) -> Bound:
        """The bound when some parameters are known beforehand; their errors are zero."""
        known = np.array(parameters)
        free = np.setdiff1d(np.arange(SHARED), known)
        fixed = self.covariance[np.ix_(known, known)]
        mixed = self.covariance[np.ix_(free, known)]
        made = np.zeros_like(self.covariance)
        made[np.ix_(free, free)] = self.covariance[np.ix_(free, free)] - mixed @ np.linalg.solve(fixed, mixed.T)
        return Bound(made)

    def draws(self, rng: np.random.Generator) -> Array:
        """Errors (200, 26) of the shared parameters as the best calibration would make them."""
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-30))
        values, vectors = np.linalg.eigh(self.covariance / scale[:, None] / scale)
        return np.asarray(rng.standard_normal((DRAWS, SHARED)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T * scale)


def cramer_rao(world: HeadWorld, noise: Noise) -> Bound:
    """The bound; poses of the flange and positions of the rail are unknowns that are read with their noise."""
    total = np.zeros((SHARED, SHARED))
    prior = np.diag(1 / noise.own**2)
    nothing = np.zeros(OWN)
    views = range(len(world.rails))
    ids = [seen_dots(world.dots(view, nothing)) for view in views]
    rows = [np.flatnonzero(seen_rows(world, view, nothing)[1]).astype(np.float64) for view in views]

    def predicted(there: HeadWorld, view: int, own: Array) -> Array:
        dots = there.dots(view, own)[ids[view]] / noise.dots
        return np.concatenate([dots.ravel(), there.stripe(view, own, rows[view])[0] / noise.stripe])

    pairs = [(world.moved(step), world.moved(-step)) for step in np.diag(STEPS)]
    for view in views:
        shared = [
            (predicted(more, view, nothing) - predicted(less, view, nothing)) / (2 * size)
            for (more, less), size in zip(pairs, STEPS, strict=True)
        ]
        here = np.column_stack(shared)
        mine = differentiated(lambda own, view=view: predicted(world, view, own), np.full(OWN, 1e-6))  # type: ignore[misc]
        cross = here.T @ mine
        total += here.T @ here - cross @ np.linalg.solve(mine.T @ mine + prior, cross.T)
    scale = 1 / np.sqrt(np.diag(total))
    covariance = np.linalg.inv(total * scale[:, None] * scale) * scale[:, None] * scale
    return Bound(0.5 * (covariance + covariance.T))


def differentiated(function: Callable[[Array], Array], steps: Array) -> Array:
    """Jacobian (m, n) at zero of a function of n arguments, by central differences of the given steps (n,)."""
    columns = []
    for k, size in enumerate(steps):
        step = np.zeros(len(steps))
        step[k] = size
        columns.append((function(step) - function(-step)) / (2 * size))
    return np.column_stack(columns)

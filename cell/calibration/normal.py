"""Normal equations of the joint adjustment in the shape that it has: shared parameters, and a few of each view's own.

Views touch each other only through the shared parameters, so their own are eliminated view by view (Schur complement):
the work grows with the number of views, not with its cube.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.calibration.blocks import OWN, SHARED
from cell.geometry.camera import Array

GROUPS = ("dots", "stripe", "shift", "turn", "rail", "lens")


@dataclass(eq=False)
class Block:
    """Information of one group of measurements: shared (27, 27), shared by own (n, 27, 7), own (n, 7, 7)."""

    shared: Array
    cross: Array
    own: Array
    squares: float = 0.0
    count: int = 0


@dataclass(eq=False)
class Inverse:
    """The same blocks of the covariance; fixed parameters have zeros."""

    shared: Array
    cross: Array
    own: Array

    def taken(self, block: Block) -> float:
        """Degrees of freedom that the parameters take from a group: the trace of covariance times information."""
        own = np.sum(self.own * block.own) + 2 * np.sum(self.cross * block.cross)
        return float(np.sum(self.shared * block.shared) + own)


class Normal:
    """Accumulates groups of whitened Jacobians and residuals, then solves."""

    def __init__(self, views: int, free: NDArray[np.bool_], own_free: NDArray[np.bool_]) -> None:
        """`free` (27,) and `own_free` (7,) say which parameters move."""
        self.groups = {
            name: Block(np.zeros((SHARED, SHARED)), np.zeros((views, SHARED, OWN)), np.zeros((views, OWN, OWN)))
            for name in GROUPS
        }
        self.right = np.zeros(SHARED)
        self.right_own = np.zeros((views, OWN))
        self._free, self._own_free = np.flatnonzero(free), np.flatnonzero(own_free)
        self._views = views

    @property
    def total(self) -> float:
        """The robust sum of squares."""
        return float(sum(block.squares for block in self.groups.values()))

    @property
    def measured(self) -> int:
        """Number of measurements, priors included."""
        return sum(block.count for block in self.groups.values())

    @property
    def parameters(self) -> int:
        """Number of parameters that move."""
        return len(self._free) + self._views * len(self._own_free)

    def add_view(self, name: str, view: int, jacobian: Array, residual: Array, cost: float) -> None:
        """Rows (m, 34) of one view, whitened, with their whitened residuals (m,)."""
        block = self.groups[name]
        shared, own = jacobian[:, :SHARED], jacobian[:, SHARED:]
        block.shared += shared.T @ shared
        block.cross[view] += shared.T @ own
        block.own[view] += own.T @ own
        self.right += shared.T @ residual
        self.right_own[view] += own.T @ residual
        block.squares += cost
        block.count += len(residual)

    def add_prior(self, name: str, view: int, first: int, white: Array, deviation: float) -> None:
        """Whitened departures (m,) of a view's own parameters from `first` on, each with one standard deviation."""
        index = np.arange(first, first + len(white))
        self.groups[name].own[view, index, index] += 1 / deviation**2
        self.right_own[view, index] += white / deviation
        self._count(name, white)

    def add_shared_prior(self, name: str, index: NDArray[np.intp], white: Array, deviation: Array) -> None:
        """Whitened departures (m,) of shared parameters, with their standard deviations (m,)."""
        self.groups[name].shared[index, index] += 1 / deviation**2
        self.right[index] += white / deviation
        self._count(name, white)

    def step(self, damping: float) -> Array:
        """The damped step (27 + 7 per view,)."""
        shared, cross, own, right, right_own = self._free_parts()
        # In units in which the information's diagonal is 1.
        a = 1 / np.sqrt(np.maximum(np.diag(shared), 1e-30))
        b = 1 / np.sqrt(np.maximum(np.einsum("kii->ki", own), 1e-30))
        shared = shared * a[:, None] * a + damping * np.eye(len(a))
        cross = cross * a[None, :, None] * b[:, None, :]
        own = own * b[:, :, None] * b[:, None, :] + damping * np.eye(b.shape[1])
        right, right_own = right * a, right_own * b
        eliminated = np.linalg.solve(own, np.concatenate([cross.transpose(0, 2, 1), right_own[:, :, None]], axis=2))
        reduced = shared - np.einsum("kij,kjl->il", cross, eliminated[:, :, :-1])
        shared_step = np.linalg.solve(reduced, right - np.einsum("kij,kj->i", cross, eliminated[:, :, -1]))
        own_step = eliminated[:, :, -1] - eliminated[:, :, :-1] @ shared_step
        step, own_all = np.zeros(SHARED), np.zeros((self._views, OWN))
        step[self._free] = shared_step * a
        own_all[:, self._own_free] = own_step * b
        return np.concatenate([step, own_all.ravel()])

    def inverse(self) -> Inverse:
        """Covariance blocks at the solution."""
        shared, cross, own, _, _ = self._free_parts()
        own_inverse = np.linalg.inv(own)
        gain = cross @ own_inverse
        reduced = shared - np.einsum("kij,klj->il", gain, cross)
        scale = 1 / np.sqrt(np.diag(reduced))
        covariance = np.linalg.inv(reduced * scale[:, None] * scale) * scale[:, None] * scale
        result = Inverse(
            np.zeros((SHARED, SHARED)), np.zeros((self._views, SHARED, OWN)), np.zeros((self._views, OWN, OWN))
        )
        mixed = -covariance @ gain
        result.shared[np.ix_(self._free, self._free)] = covariance
        result.cross[np.ix_(np.arange(self._views), self._free, self._own_free)] = mixed
        result.own[np.ix_(np.arange(self._views), self._own_free, self._own_free)] = (
            own_inverse - gain.transpose(0, 2, 1) @ mixed
        )
        return result

    def _free_parts(self) -> tuple[Array, Array, Array, Array, Array]:
        free, own_free, views = self._free, self._own_free, np.arange(self._views)
        blocks = self.groups.values()
        shared = np.sum([b.shared for b in blocks], axis=0)[np.ix_(free, free)]
        cross = np.sum([b.cross for b in blocks], axis=0)[np.ix_(views, free, own_free)]
        own = np.sum([b.own for b in blocks], axis=0)[np.ix_(views, own_free, own_free)]
        return shared, cross, own, self.right[free], self.right_own[:, own_free]

    def _count(self, name: str, white: Array) -> None:
        self.groups[name].squares += float(white @ white)
        self.groups[name].count += len(white)

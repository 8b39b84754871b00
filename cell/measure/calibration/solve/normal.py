"""Normal equations of the joint adjustment in the shape that it has: shared parameters, and a few of each view's own.

Rests of the arm touch each other only through the shared parameters, so their own (one flange pose, and a rail position
for each view) are eliminated rest by rest (Schur complement): the work grows with the number of views, not its cube.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.measure.calibration.solve.blocks import OWN, SHARED
from cell.measure.geometry.camera import Array

GROUPS = ("dots", "stripe", "shift", "turn", "rail", "lens")


@dataclass(eq=False)
class Block:
    """Information of a group of measurements: shared (27, 27), and by view shared by own (n, 27, 7), own (n, 7, 7)."""

    shared: Array
    cross: Array
    own: Array
    squares: float = 0.0
    count: float = 0.0


@dataclass(eq=False)
class Inverse:
    """The same blocks of the covariance; fixed parameters have zeros. Views of one rest repeat its flange's."""

    shared: Array
    cross: Array
    own: Array

    def taken(self, block: Block) -> float:
        """Degrees of freedom that the parameters take from a group: the trace of covariance times information."""
        own = np.sum(self.own * block.own) + 2 * np.sum(self.cross * block.cross)
        return float(np.sum(self.shared * block.shared) + own)


class Normal:
    """Accumulates groups of whitened Jacobians and residuals, then solves."""

    def __init__(self, rests: NDArray[np.intp], free: NDArray[np.bool_], own_free: NDArray[np.bool_]) -> None:
        """`rests` (views,) numbers the rest of the arm in which each view was taken; free ones of (27,) and (7,) move.

        Views of one rest have one flange pose in common; each has a rail position of its own.
        """
        views = len(rests)
        self.groups = {
            name: Block(np.zeros((SHARED, SHARED)), np.zeros((views, SHARED, OWN)), np.zeros((views, OWN, OWN)))
            for name in GROUPS
        }
        self.right = np.zeros(SHARED)
        self.right_own = np.zeros((views, OWN))
        self._free, self._own_free = np.flatnonzero(free), np.flatnonzero(own_free)
        self._views, self._rests = views, rests
        # Where a view's free own parameters stand among its rest's: the flange's first, then a rail for each view.
        turn = np.array([np.count_nonzero(rests[:k] == rest) for k, rest in enumerate(rests)], dtype=np.intp)
        self._places = np.tile(self._own_free, (views, 1))
        self._places[:, self._own_free == OWN - 1] += turn[:, None]

    @property
    def total(self) -> float:
        """The robust sum of squares."""
        return float(sum(block.squares for block in self.groups.values()))

    def add_view(self, name: str, view: int, jacobian: Array, residual: Array, cost: float, share: float = 1.0) -> None:
        """Rows (m, 34) of one view, whitened, with their whitened residuals (m,), a share of which is independent."""
        block = self.groups[name]
        shared, own = jacobian[:, :SHARED], jacobian[:, SHARED:]
        block.shared += shared.T @ shared
        block.cross[view] += shared.T @ own
        block.own[view] += own.T @ own
        self.right += shared.T @ residual
        self.right_own[view] += own.T @ residual
        block.squares += cost
        block.count += share * len(residual)

    def add_prior(self, name: str, view: int, first: int, white: Array, deviation: float) -> None:
        """Whitened departures (m,) of a view's own parameters from `first` on, each with one standard deviation."""
        index = np.arange(first, first + len(white))
        self.groups[name].own[view, index, index] += 1 / deviation**2
        self.right_own[view, index] += white / deviation
        self._count(name, white)

    def add_shared_rows(self, name: str, rows: Array, residual: Array) -> None:
        """Whitened rows (m, 27) on the shared parameters alone, with their whitened residuals (m,)."""
        self.groups[name].shared += rows.T @ rows
        self.right += rows.T @ residual
        self._count(name, residual)

    def step(self, damping: float) -> Array:
        """The damped step (27 + 7 per view,); views of one rest have the flange's in common."""
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
        own_all[:, self._own_free] = (own_step * b)[self._rests[:, None], self._places]
        return np.concatenate([step, own_all.ravel()])

    def promised(self, step: Array) -> float:
        """By how much a Gauss–Newton step (27 + 7 per view,) lowers the sum of squares if the problem is linear."""
        return float(self.right @ step[:SHARED] + self.right_own.ravel() @ step[SHARED:])

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
        inner = own_inverse - gain.transpose(0, 2, 1) @ mixed
        views, rests, places = np.arange(self._views), self._rests[:, None, None], self._places
        result.shared[np.ix_(self._free, self._free)] = covariance
        result.cross[np.ix_(views, self._free, self._own_free)] = mixed[
            rests, np.arange(len(self._free))[:, None], places[:, None, :]
        ]
        result.own[np.ix_(views, self._own_free, self._own_free)] = inner[rests, places[:, :, None], places[:, None, :]]
        return result

    def _free_parts(self) -> tuple[Array, Array, Array, Array, Array]:
        """Of the free parameters: shared, shared by own of each rest, own of each rest, and both right sides."""
        free, own_free, views = self._free, self._own_free, np.arange(self._views)
        blocks = self.groups.values()
        shared = np.sum([b.shared for b in blocks], axis=0)[np.ix_(free, free)]
        cross = np.sum([b.cross for b in blocks], axis=0)[np.ix_(views, free, own_free)]
        own = np.sum([b.own for b in blocks], axis=0)[np.ix_(views, own_free, own_free)]
        count, width = int(self._rests.max()) + 1, int(self._places.max()) + 1
        rests, places = self._rests[:, None], self._places
        by_rest, right = np.zeros((count, width, len(free))), np.zeros((count, width))
        inner = np.zeros((count, width, width))
        np.add.at(by_rest, (rests, places), cross.transpose(0, 2, 1))
        np.add.at(inner, (rests[:, :, None], places[:, :, None], places[:, None, :]), own)
        np.add.at(right, (rests, places), self.right_own[:, own_free])
        # A rest of fewer views than another has fewer rail positions: those that do not exist stay where they are.
        missing = np.ones((count, width), dtype=np.bool_)
        missing[rests, places] = False
        inner[np.nonzero(missing)[0], np.nonzero(missing)[1], np.nonzero(missing)[1]] = 1.0
        return shared, by_rest.transpose(0, 2, 1), inner, self.right[free], right

    def _count(self, name: str, white: Array) -> None:
        self.groups[name].squares += float(white @ white)
        self.groups[name].count += len(white)

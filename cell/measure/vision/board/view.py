"""What a picture shows of a board: which points, where, and how sure their order is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.spec import BoardSpec


@dataclass(frozen=True, eq=False)
class BoardView:
    """The points of a board that were found in a picture of `size` (width, height) px.

    `ids` (n,) are indices into `spec.points()`, `pixels` (n, 2) the points' places, for dots the centres of their
    ellipses, `sigma` (n,) one standard deviation of each in px. `order_assumed` is True when the board looks the same
    turned by a half or a quarter turn: the order then rests on the set-up (first point towards the upper left of the
    picture), and `turns` gives the others. `dot_radius` is that of the dots in m, 0 for corners.
    """

    spec: BoardSpec
    size: tuple[int, int]
    ids: NDArray[np.intp]
    pixels: Array
    sigma: Array
    order_assumed: bool = False
    dot_radius: float = 0.0

    @property
    def object_points(self) -> Array:
        """The points (n, 3) in the board frame in m, in the order of `ids`."""
        return self.spec.points()[self.ids]

    @property
    def complete(self) -> bool:
        """True when no point of the board is missing."""
        return len(self.ids) == len(self.spec.lattice())

    def turns(self) -> list[BoardView]:
        """This view and those with the other orders that the board's symmetry allows."""
        if not self.order_assumed:
            return [self]
        lattice = self.spec.lattice()
        quarter = self.spec.kind == "dots" and self.spec.cols == self.spec.rows
        views = []
        for turn in range(4) if quarter else (0, 2):
            places = {tuple(p): k for k, p in enumerate(turned_places(lattice, turn))}
            index = np.array([places[tuple(p)] for p in lattice])
            views.append(replace(self, ids=index[self.ids]))
        return views


def turned_places(places: NDArray[np.intp], quarters: int) -> NDArray[np.intp]:
    """Lattice places (n, 2) turned by quarter turns and moved back to start at (0, 0)."""
    turned = places
    for _ in range(quarters % 4):
        turned = np.column_stack([-turned[:, 1], turned[:, 0]])
    return np.asarray(turned - turned.min(axis=0), dtype=np.intp)

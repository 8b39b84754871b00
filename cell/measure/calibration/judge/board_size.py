"""The board's size against the arm's ways: a board that is printed larger or smaller than its name says shows here.

Camera, rail and laser take their metres from the board, the flange's poses theirs from the arm. How much larger the
board would have to be is one more parameter of the adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.measure.calibration.solve.adjustment import Adjusted, Adjustment
from cell.measure.calibration.solve.blocks import SHARED
from cell.measure.calibration.solve.extra_parameter import one_more
from cell.measure.geometry.camera import Array
from drivers.errors import Measured, RefusedError

ARM_SHARE = 0.5e-3
"""One standard deviation of what an arm's lengths and the optics do to the size that a board seems to have, beside the
arm's scatter. 34 simulated cells whose boards are as named: fine -0.3 ± 0.5 per mille, large 0.1 ± 0.2."""
NOTED, REFUSED = 3.5, 5.0
"""Standard deviations."""
LEAST_REFUSED = 4e-3
"""A board that is off by less puts a place off by less than it is known to anyway, and that is stated."""


@dataclass(frozen=True, eq=False)
class BoardSize:
    """By what `share` the board, "fine" or "large", of `pitch` in m as named, seems larger than its name says.

    `sigma` is one standard deviation of it, `moved` (27,) what the shared parameters would move if its size were free.
    """

    board: str
    pitch: float
    share: float
    sigma: float
    moved: Array

    @property
    def noted(self) -> bool:
        """Whether it is more than chance, gears and optics make."""
        return abs(self.share) > NOTED * self.sigma

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, what is not as usual."""
        if not self.noted:
            return ()
        return (f"{self._words}; the stated uncertainty allows for it. Measure the pitch, over many of them",)

    def allowed_for(self, adjusted: Adjusted) -> Adjusted:
        """The adjustment with what a board of that size would move in its covariance, where it is noted."""
        if not self.noted:
            return adjusted
        moved = self.moved / adjusted.inflation
        return replace(adjusted, covariance=adjusted.covariance + np.outer(moved, moved))

    def require(self) -> None:
        """Raise `RefusedError` for a board of another size."""
        most = max(REFUSED * self.sigma, LEAST_REFUSED)
        if abs(self.share) <= most:
            return
        raise RefusedError(
            f"{self._words}. Measure it over many pitches: if it is so, name that pitch in cell.toml "
            f"([calibration.{self.board}]); if not, the arm is not the one that its controller says. Then run "
            "`cell calibrate`",
            Measured(f"the {self.board} board's size, off its name", 100 * self.share, "%", most=100 * most),
        )

    @property
    def _words(self) -> str:
        return (
            f"by the arm's ways the {self.board} board is {1 + self.share:.4f} ± {self.sigma:.4f} times as large as "
            f"its name says: its pitch would be {1e3 * self.pitch * (1 + self.share):.4g} mm, not "
            f"{1e3 * self.pitch:.4g} mm"
        )


def board_size(board: str, pitch: float, problem: Adjustment, found: Adjusted) -> BoardSize:
    """Of an adjustment's minimum. Its deviation counts the scatter of the arm that was found there."""
    state = found.state

    def by_size(k: int, rows: Array) -> Array:
        # A larger board moves its points away from its origin.
        away = problem.views[k].points @ state.base_from_board.rotation.T
        return np.asarray(np.einsum("nij,nj->ni", rows[:, 21:24].reshape(-1, 2, 3), away).ravel())

    larger = one_more(problem, state, "dots", by_size)
    if not larger.information > 0:
        return BoardSize(board, pitch, 0.0, np.inf, np.zeros(SHARED))
    # The stripe is weighed in m, by depths that are held still: a smaller board would fit it better by up to so much.
    pull = problem.normal_at(state).groups["stripe"].squares / larger.information
    scatter = float(np.linalg.norm([found.inflation * larger.sigma, ARM_SHARE, pull]))
    return BoardSize(board, pitch, larger.value, scatter, larger.value * larger.gain)

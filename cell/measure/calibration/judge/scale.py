"""The board's size against the arm's travel: a board of another pitch, or poses in another unit, show here.

Camera, rail and laser take their metres from the board, the flange's poses theirs from the arm. How much larger the
board would have to be is one more parameter of the adjustment, or of the poses alone.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from cell.measure.calibration.judge.checks import QualityCheck
from cell.measure.calibration.solve.adjustment import Adjusted, Adjustment
from cell.measure.calibration.solve.bow import one_more
from cell.measure.calibration.solve.normal import SHARED
from cell.measure.calibration.solve.starts import park_martin
from cell.measure.geometry.camera import Array
from drivers.errors import Measured, RefusedError

LEAST_FRAMES = 5
DOUBT, REFUSE = 1.0, 5.0
DOUBT_SIGMAS, REFUSE_SIGMAS, UNSURE_SIGMAS = 3.0, 5.0, 2.0
NAMED_SHARE = 1e-3
"""One standard deviation of a board's size beside its name: paper swells, printers scale."""
EXPLAINS, CLEARLY = 0.5, 0.7
"""Shares of the squared residuals from which a scale is believed, and from which it refuses by itself."""
INDEPENDENT = (
    "closed form against adjustment", "closed form against least squares", "board in left-out frames",
    "board in left-out pairs", "the arm's scatter",
)  # fmt: skip
"""Checks of the hand-eye that say the same by other means."""


@dataclass(frozen=True, eq=False)
class Scale:
    """By how much the board would have to be larger to agree with the arm's metres, and its deviation.

    `shift` (3,) in m is what the camera would move on the flange if the scale were free; `explained` the share of the
    squared residuals that would go with it.
    """

    value: float
    sigma: float
    shift: Array
    explained: float

    @property
    def believed(self) -> bool:
        """True when the arm and the board's name do not agree, and a scale makes most of what they differ by. What that
        moves is not known better. A scale that explains little is picked up from something else."""
        return abs(self.value - 1) > DOUBT_SIGMAS * self.sigma and self.explained > EXPLAINS

    @property
    def unsure(self) -> float:
        """Share of what a free scale would move that the hand-eye is not known to: all where it is believed.

        Else as much as it is beyond chance, and as a board may be off its name where the pictures do not tell better: a
        few per mille never explain most of what is left.
        """
        off = abs(self.value - 1)
        beyond = min(1.0, off / max(UNSURE_SIGMAS * self.sigma, 1e-12))
        return 1.0 if self.believed else math.hypot(beyond, min(self.sigma, NAMED_SHARE) / max(off, 1e-12))

    def check(self, others: Iterable[QualityCheck]) -> QualityCheck:
        """How far it is from 1; a doubt where it stands alone against the `others` of the hand-eye."""
        alone = self.explained < CLEARLY and all(c.verdict == "ok" for c in others if c.name in INDEPENDENT)
        share, off = 100 * self.sigma / self.value, 100 * abs(math.log(self.value))
        return QualityCheck(
            "hand_eye", "arm's travel against the board's size", off, doubt=max(DOUBT, DOUBT_SIGMAS * share),
            refuse=math.inf if alone else max(REFUSE, REFUSE_SIGMAS * share), unit="%",
            says=f"by the arm's travel the board is {self.value:.4f} ± {self.sigma:.4f} times as large as its name "
            "says: measure its pitch; if that is right, the poses are in another unit or of another arm",
        )  # fmt: skip


def metric_scale(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> Scale | None:
    """The board's scale in the arm's unit, its deviation by leaving each frame out; None where they do not tell."""
    try:
        rotation = park_martin(flanges, boards)
    except RefusedError:
        return None
    if len(flanges) < LEAST_FRAMES:
        return None
    rows = np.array(
        [
            np.column_stack([f.rotation, -np.eye(3), f.rotation @ rotation @ b.translation])
            for f, b in zip(flanges, boards, strict=True)
        ]
    )
    travel = np.array([f.translation for f in flanges])
    solutions = []
    for left in range(-1, len(flanges)):
        kept = [k for k in range(len(flanges)) if k != left]
        solutions.append(np.linalg.lstsq(rows[kept].reshape(-1, 7), -travel[kept].ravel(), rcond=None)[0])
    values, count = np.array(solutions)[:, 6], len(flanges)
    sigma = np.sqrt((count - 1) / count * np.sum((values[1:] - values[1:].mean()) ** 2))
    if not values[0] > UNSURE_SIGMAS * sigma:
        return None
    known = rows.reshape(-1, 7)
    held = np.linalg.lstsq(known[:, :6], -travel.ravel() - known[:, 6], rcond=None)[0]
    free_off = known @ solutions[0] + travel.ravel()
    held_off = known[:, :6] @ held + known[:, 6] + travel.ravel()
    explained = 1 - float(free_off @ free_off) / max(float(held_off @ held_off), 1e-30)
    return Scale(float(values[0]), float(sigma), np.asarray(solutions[0][:3] - held[:3]), explained)


ARM_SHARE = 0.5e-3
"""One standard deviation of what an arm's lengths and the optics do to the size that a board seems to have, beside the
arm's scatter. 34 simulated cells whose boards are as named: fine -0.3 ± 0.5 per mille, large 0.1 ± 0.2."""
NOTED, REFUSED = 3.5, 5.0
"""Standard deviations."""
LEAST_REFUSED = 4e-3
"""A board that is off by less puts a place off by less than it is known to anyway, and that is stated."""


@dataclass(frozen=True, eq=False)
class BoardSize:
    """By what `share` the board, "fine" or "large", of `pitch` in m as named, seems larger than its name says. `sigma`
    is one standard deviation of it, `moved` (27,) what the shared parameters would move if its size were free."""

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

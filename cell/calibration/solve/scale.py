"""The arm's travel against the board's size: a board with another pitch, or poses in another unit, show here.

Whatever the hand-eye, the flange's travel in its own unit and the board as the camera sees it fix one scale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.calibration.solve.checks import Check
from cell.calibration.solve.hand_eye import park_martin
from cell.geometry.camera import Array
from drivers.errors import RefusedError

UNITS = {1000.0: "mm", 100.0: "cm", 1 / 0.0254: "inches"}
UNIT_SHARE = 0.2
LEAST_FRAMES = 5
DOUBT, REFUSE = 1.0, 5.0
DOUBT_SIGMAS, REFUSE_SIGMAS = 3.0, 5.0


@dataclass(frozen=True, eq=False)
class Scale:
    """By how much the board would have to be larger to agree with the arm's metres, and its deviation.

    `shift` (3,) in m is what the camera would move on the flange if the scale were free.
    """

    value: float
    sigma: float
    shift: Array

    @property
    def believed(self) -> bool:
        """True when the arm and the board's name do not agree: what that moves is not known better."""
        return abs(self.value - 1) > DOUBT_SIGMAS * self.sigma

    @property
    def unit(self) -> str | None:
        """The unit in which the arm's positions seem to be; None when it is the metre or none that is known."""
        return next((name for factor, name in UNITS.items() if abs(self.value / factor - 1) < UNIT_SHARE), None)

    def check(self) -> Check:
        """How far it is from 1."""
        share = 100 * self.sigma / max(abs(self.value), 1e-9)
        off = 100 * abs(math.log(max(self.value, 1e-9)))
        if self.unit is not None:
            says = f"by the pictures the flange's positions are in {self.unit}, not in m"
        else:
            says = (
                f"by the arm's travel the board is {self.value:.4f} ± {self.sigma:.4f} times as large as its name "
                "says: measure its pitch; if that is right, the poses are in another unit or of another arm"
            )
        return Check(
            "hand_eye", "arm's travel against the board's size", off, max(DOUBT, DOUBT_SIGMAS * share),
            max(REFUSE, REFUSE_SIGMAS * share), "%", says,
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
    known = rows.reshape(-1, 7)
    held = np.linalg.lstsq(known[:, :6], -travel.ravel() - known[:, 6], rcond=None)[0]
    return Scale(float(values[0]), float(sigma), np.asarray(solutions[0][:3] - held[:3]))

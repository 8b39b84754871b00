"""The laser's witness against the board: did the laser turn since the calibration, or was the witness's plate knocked?

A job has nothing but the plate to go by. A verification sees the stripe on the board as well, which was photographed
from the same pose, and needs no plate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.measure.calibration.drift.evidence import DriftEvidence
from cell.measure.calibration.drift.reference_plate import LARGEST_RAD, NOTED_RAD, ConfirmedTurn, Pointing, turned
from cell.measure.calibration.solve.blocks import HAND, PLANE, SHARED, AdjustmentState, tangents
from cell.measure.geometry.camera import Array

APART = 3.5
"""Standard deviations by which witness and board may differ. Normal errors do so in 0.05 % of all checks."""
_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class WitnessCheck:
    """How far the light plane has turned as the `plate` and as the `board` show it, about the laser's exit.

    `wrong` (27,) is what the scan chain of a job is off by that believes the plate.
    """

    plate: Pointing
    board: Pointing
    wrong: Array

    @classmethod
    def of(cls, plate: Pointing, exit_point: Array, state: AdjustmentState, weighed: DriftEvidence) -> WitnessCheck:
        """From what the plate shows and the `weighed` evidence of the board against the calibrated `state`."""
        assert state.plane is not None
        there = turned(state.plane, exit_point, _STEP)
        by_turn = np.zeros(SHARED)
        first, second = tangents(state.plane.n)
        by_turn[PLANE] = first @ there.n, second @ there.n, there.distance - state.plane.distance
        by_turn /= _STEP
        # With the camera's mount free, which one view of the board does not tell from the board's place.
        change, covariance = weighed.change(np.column_stack([by_turn, np.eye(SHARED)[:, HAND]]))
        board = Pointing(float(change[0]), float(np.sqrt(covariance[0, 0])))
        return cls(plate, board, by_turn * (plate.turn - board.turn))

    @property
    def plate_moved(self) -> bool:
        """True when the board contradicts the plate."""
        return abs(self.plate.turn - self.board.turn) > APART * float(np.hypot(self.plate.sigma, self.board.sigma))

    @property
    def corrects(self) -> bool:
        """True when the laser has turned, as the board says, too, so that jobs are right to allow for it."""
        return abs(self.plate.turn) > NOTED_RAD and not self.plate_moved

    def confirmation(self, made: float) -> ConfirmedTurn | None:
        """The turn as the board measured it, to be kept for jobs; `made` in seconds since the epoch.

        None where there is nothing to confirm, or the board is no judge: it contradicts the plate, tells less than a
        job needs, or shows more than warmth does to a laser.
        """
        board = self.board
        if not self.corrects or board.sigma > NOTED_RAD or abs(board.turn) > LARGEST_RAD:
            return None
        return ConfirmedTurn(self.plate.turn, board.turn, board.sigma, made)

    @property
    def words(self) -> str:
        """Both figures."""
        return (
            f"{1e3 * self.plate.turn:+.2f} ± {1e3 * self.plate.sigma:.2f} mrad by the plate on the claw, "
            f"{1e3 * self.board.turn:+.2f} ± {1e3 * self.board.sigma:.2f} mrad by the board"
        )

    def as_dict(self) -> dict[str, Any]:
        """For reports."""
        figures = {"plate": self.plate, "board": self.board}
        made = {f"{name}_mrad": round(1e3 * one.turn, 4) for name, one in figures.items()}
        made |= {f"{name}_sigma_mrad": round(1e3 * one.sigma, 4) for name, one in figures.items()}
        return {**made, "plate_moved": self.plate_moved}

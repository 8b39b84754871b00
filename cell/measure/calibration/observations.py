"""What a calibration is made of: a picture of a board, a stripe on it, where the flange was and where the rail."""

from __future__ import annotations

from dataclasses import dataclass

import pinocchio as pin

from cell.measure.vision.board.view import BoardView
from cell.measure.vision.stripe.extract import StripeProfile


@dataclass(frozen=True, eq=False)
class ScanObservation:
    """One arm pose of a scan camera's calibration.

    `view` is the board in a picture, `profile` the laser stripe on the same board at the same pose, in the same picture
    or another; either may be None, not both. `base_from_flange` as the arm reports it, `rail_position` in m.
    `same_rest` says that only the rail has moved since the observation before: the arm's repeatability is the same.
    """

    view: BoardView | None
    profile: StripeProfile | None
    base_from_flange: pin.SE3
    rail_position: float = 0.0
    name: str = ""
    same_rest: bool = False


@dataclass(frozen=True, eq=False)
class TargetObservation:
    """One arm pose of a camera that sees a board at rest; `base_from_flange` as the arm reports it."""

    view: BoardView
    base_from_flange: pin.SE3
    name: str = ""

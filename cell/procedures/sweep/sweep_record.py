"""What the laser sweep brought: one swath after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.measure.calibration.drift.reference_plate import Pointing
from cell.measure.calibration.drift.slip import Slip
from cell.measure.vision import StripeProfile
from cell.procedures.sweep.swath import Swath
from drivers.interfaces import ArmMotion, Frame, Vector


@dataclass(frozen=True, eq=False)
class SweepRecord:
    """What the sweeps brought, in their order; at least one. `pointing` of the laser and `slip` of the head, where a
    witness told them; `doubts` for people: what of calibration and arm is not as one would have it. `earlier` names the
    run that swept, where it was another one. `rest` is the motion that brought the arm to where it stood meanwhile, if
    it did: as long as that is the arm's newest, it stands there."""

    swaths: tuple[Swath, ...]
    pointing: Pointing | None = None
    doubts: tuple[str, ...] = ()
    slip: Slip | None = None
    earlier: str = ""
    rest: ArmMotion | None = None

    @property
    def base_from_flange(self) -> pin.SE3:
        """Where the flange was half-way through the first sweep."""
        return self.swaths[0].base_from_flange

    @property
    def times(self) -> Vector:
        """When each line was taken, sweep after sweep, s."""
        return np.concatenate([swath.times for swath in self.swaths])

    @property
    def middle(self) -> Frame:
        """The frame from the middle of the first sweep."""
        return self.swaths[0].middle

    @property
    def middle_profile(self) -> StripeProfile:
        """The stripe in `middle`."""
        return self.swaths[0].middle_profile

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not as usual, for people."""
        turned = self.pointing.notes if self.pointing is not None else ()
        return (*turned, *(() if self.slip is None else self.slip.notes), *self.doubts)

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "sweeps": len(self.swaths),
            "profiles": sum(len(swath.lines) for swath in self.swaths),
            "lost_frames": sum(swath.lost for swath in self.swaths),
            "points": sum(swath.points for swath in self.swaths),
            "residual_um": [round(1e6 * swath.residual, 2) for swath in self.swaths],
            "laser_turned_mrad": None if self.pointing is None else round(1e3 * self.pointing.turn, 4),
            "laser_confirmed_mrad": None if self.pointing is None else round(1e3 * self.pointing.confirmed, 4),
            "head_slipped_um": None if self.slip is None else [round(1e6 * v, 1) for v in self.slip.shift],
            "pictures_later_ms": None if self.slip is None else round(1e3 * self.slip.lag, 2),
            "time_shift_um": [round(1e6 * swath.shift, 2) for swath in self.swaths],
        }

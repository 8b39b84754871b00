"""Pick: the part that the sweep found is gripped where it lies, felt, and lifted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import to_ur
from cell.measure.inversion import PlacePose
from cell.measure.inversion.part_pose import seen_from_below
from cell.procedures.arm.moves import PartState
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.steps.board_photo import require_unmoved
from cell.procedures.steps.gripping import GRIPPED, take
from cell.procedures.steps.workplace import JobStep, Workplace
from drivers.errors import RefusedError
from drivers.interfaces import Vector
from statemachine.runner import StepContext
from statemachine.step import OnFailure, Step

MOST_PULL = 3.0
"""Times the contact force with which a part is pulled at, at most: more, and it sticks."""


@dataclass(frozen=True, eq=False)
class HeldPart:
    """A part in the claw: where the flange gripped it, base_from_flange, and how exactly it is known how it is held,
    (6, 6) m² and rad², about the part's origin."""

    base_from_flange: pin.SE3
    covariance: Vector

    def summary(self) -> dict[str, object]:
        """Figures for journal and report."""
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            "base_from_flange": [round(float(v), 6) for v in to_ur(self.base_from_flange)],
            "sigma_mm": [round(1e3 * float(v), 4) for v in sigma[:3]],
            "sigma_mrad": [round(1e3 * float(v), 4) for v in sigma[3:]],
        }


def _at(here: Workplace, context: StepContext) -> HeldPart:
    pose, fix, job = context.made(PlacePose), context.made(BoardFix), here.job
    if here.part.state is not PartState.LIES:
        raise RefusedError(f"the part is {here.part.state.value}: nothing is gripped a second time")
    require_unmoved(here, fix, "before the part was measured", context.progress)
    context.safe_point()
    held = job.grasp.flange_from_part.se3()
    grip = pose.base_from_surface * job.place.surface_from_part.se3() * held.inverse()
    here.part.where = pose.base_from_surface
    _lies(here, fix, pose.base_from_surface)
    take(here, job, grip, context, what="the part", most_pull=MOST_PULL * job.place.contact_force)
    if not here.devices.claw.holding:
        raise RefusedError("the claw lost the part as it lifted it; look where it fell, and at the fingers")
    return HeldPart(grip, pose.covariance + here.repeatability + GRIPPED)


def _lies(here: Workplace, fix: BoardFix, base_from_part: pin.SE3) -> None:
    """From here on the arm avoids the part, and what lies below it, each by itself: one stays when the other goes."""
    part = here.part_mesh
    assert part is not None
    below = seen_from_below(part, here.job.place.surface_from_part.se3())
    base_from_place = fix.base_from_board * here.job.place_from_board.inverse()
    here.mover.meet_station(base_from_place, here.job, here.board, below.extent)
    here.mover.part_lies(base_from_part, here.job.grasp.size)


# What was interrupted with the part between the fingers is left to a person.
STEP = JobStep(Step("pick", 180.0, on_failure=OnFailure.STOP), _at, HeldPart, needs=(BoardFix, PlacePose))

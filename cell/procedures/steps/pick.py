"""Pick: the part that the sweep found is gripped where it lies, felt, and lifted.

The open claw goes down to a part that lies, closes on it and lifts it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.config.job import Job
from cell.measure.geometry.poses import from_parts, from_ur, to_ur
from cell.measure.inversion import PlacePose
from cell.measure.inversion.part_pose import seen_from_below
from cell.motion.collision import TOUCHES
from cell.procedures.arm.moves import PartState
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.grasp import GRIPPED
from cell.procedures.steps.place import FAST_FORCE, NEAR_M, carried_on, note_part
from cell.procedures.steps.reconstruct import Reconstruction
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.second_look import require_in_place
from cell.procedures.sweep.stored_sweep import SweepRecord
from cell.procedures.sweep.sweeping import check_lost_steps
from drivers.errors import Measured, RefusedError
from drivers.interfaces import Vector
from statemachine.runner import StepContext
from statemachine.step import OnFailure, Step

MOST_PULL = 3.0
"""Times the contact force with which a part is pulled at, at most: more, and it sticks."""


def take(workplace: Workplace, job: Job, grip: pin.SE3, context: StepContext, *, what: str, pulls: bool = True) -> None:
    """Grip the part, `what` in words, with the flange at `grip`, base_from_flange, and lift it.

    Raises `RefusedError` where the claw meets something on its way down, and, with `pulls`, where the part is lost, or
    sticks: it is let go again then.
    """
    if pulls:
        # After a grip that found no part its fingers are closed.
        workplace.devices.claw.release()
    plan, mover, part = job.place, workplace.mover, workplace.part
    normal = job.grasp.flange_from_part.se3().rotation[:, 2]
    above = grip * from_parts(plan.approach * normal)
    context.progress(0.5, f"gripping {what}")
    context.check()
    mover.follow(mover.plan_to(above, f"above {what}"))
    mover.allow_part_contact()
    part.left = False
    workplace.devices.arm.zero_force()
    if not _reached(workplace, grip, normal):
        mover.line(above, plan.speed, TOUCHES, near=NEAR_M, leaving=True)
        mover.forbid_part_contact()
        part.left = True
        raise RefusedError(
            f"the claw touched something as it went to grip {what}; it went back up, the part lies where it was. Look "
            "what stands there"
        )
    context.check()
    before = part.state
    part.state = PartState.UNKNOWN
    note_part(context, part)
    workplace.devices.claw.grip()
    where, part.state, part.where, part.left = part.where, PartState.HELD, None, False
    note_part(context, part)
    mover.hold_part(job.grasp.flange_from_part.se3(), job.grasp.size)
    most_pull = MOST_PULL * plan.contact_force
    if pulls and mover.line(
        grip * from_parts(plan.contact_travel * normal), plan.contact_speed, TOUCHES, force_limit=most_pull
    ):
        pull = float(np.linalg.norm(workplace.devices.arm.state().wrench[:3]))
        part.state, part.where = PartState.UNKNOWN, where
        note_part(context, part)
        workplace.devices.claw.release()
        part.state, part.left = before, True
        note_part(context, part)
        mover.empty_claw()
        mover.forbid_part_contact()
        mover.line(above, plan.speed, TOUCHES, near=NEAR_M, leaving=True)
        raise RefusedError(
            f"{what} sticks, or is heavier than place.contact_force lets the claw lift: it pulled with more than "
            f"{most_pull:.0f} N and let go, at most {1e3 * plan.contact_travel:g} mm above where the part lay. Look "
            "what holds it, or raise place.contact_force",
            Measured("pull at the part", pull, "N", most=most_pull),
        )
    mover.line(above, plan.speed, TOUCHES, near=NEAR_M, leaving=True)
    if pulls and not workplace.devices.claw.holding:
        part.state = PartState.UNKNOWN
        note_part(context, part)
        raise RefusedError("the claw lost the part as it lifted it; look where it fell, and at the fingers")


def _reached(workplace: Workplace, grip: pin.SE3, normal: Vector) -> bool:
    """Whether the open claw came down to `grip` along `normal`, (3,) on the flange, without touching anything."""
    plan, mover = workplace.job.place, workplace.mover
    slow = grip * from_parts(plan.contact_travel * normal)
    if mover.line(slow, plan.speed, TOUCHES, force_limit=FAST_FORCE * plan.contact_force, near=NEAR_M):
        return False
    # What presses already would be taken as zero.
    if not np.linalg.norm(workplace.devices.arm.state().wrench[:3]) <= plan.contact_force:
        return False
    return not mover.line(grip, plan.contact_speed, TOUCHES, force_limit=plan.contact_force)


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

    def as_dict(self) -> dict[str, object]:
        """For the journal: what a resumed run has to know of it."""
        return {"base_from_flange": to_ur(self.base_from_flange).tolist(), "covariance": self.covariance.tolist()}

    @classmethod
    def of(cls, told: Mapping[str, object]) -> "HeldPart":
        """As `as_dict` told; ValueError or KeyError for what is no such record."""
        covariance = np.array(told["covariance"], dtype=np.float64)
        if covariance.shape != (6, 6) or not np.linalg.eigvalsh(covariance)[0] >= 0.0:
            raise ValueError("its covariance is none")
        return cls(from_ur(np.array(told["base_from_flange"], dtype=np.float64)), covariance)


def _run_step(workplace: Workplace, context: StepContext) -> HeldPart:
    fix, job, part = context.made(BoardFix), workplace.job, workplace.part
    if part.state is not PartState.LIES:
        raise RefusedError(f"the part is {part.state.value}: nothing is gripped a second time")
    while True:
        before, pose = context.held_s, context.made(PlacePose)
        sweep, scan = context.made(SweepRecord), context.made(Reconstruction)
        look = require_in_place(workplace, fix, sweep, scan=scan, pose=pose, context=context)
        if look.creep is not None:
            pose = carried_on(workplace, sweep, scan, fix, look.creep)
        context.safe_point()
        # Whoever has the run held may reach in, and move the part.
        if context.held_s == before:
            break
    if not look.counted:
        check_lost_steps(workplace.devices, lambda _, text: context.progress(0.05, text))
    for note in look.notes:
        context.note(text=note)
    grip = pose.base_from_surface * job.place.surface_from_part.se3() * job.grasp.flange_from_part.se3().inverse()
    part.where = pose.base_from_surface
    _lies(workplace, fix, pose.base_from_surface)
    take(workplace, job, grip, context, what="the part")
    return HeldPart(grip, pose.covariance + workplace.repeatability + GRIPPED)


def _lies(workplace: Workplace, fix: BoardFix, base_from_part: pin.SE3) -> None:
    """From here on the arm avoids the part, and what lies below it, each by itself: one stays when the other goes."""
    part = workplace.part_mesh
    assert part is not None
    below = (
        seen_from_below(part, workplace.job.place.surface_from_part.se3()).extent
        if workplace.ground is None
        else workplace.ground
    )
    base_from_place = fix.base_from_board * workplace.job.place_from_board.inverse()
    workplace.mover.avoid_station(base_from_place, workplace.job, workplace.board, below)
    workplace.mover.avoid_part(base_from_part, workplace.job.grasp.size)


# What was interrupted with the part between the fingers is left to a person.
STEP = JobStep(
    Step("pick", 300.0, on_failure=OnFailure.STOP), _run_step, HeldPart,
    needs=(BoardFix, SweepRecord, Reconstruction, PlacePose),
)  # fmt: skip

"""Gripping: the open claw goes down to a part that lies, closes on it and lifts it."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from cell.config.job import Job
from cell.measure.geometry.poses import from_parts
from cell.motion.collision import TOUCHES
from cell.procedures.arm.moves import PartState
from cell.procedures.steps.place import FAST_FORCE, note_part
from cell.procedures.steps.workplace import Workplace
from drivers.errors import Measured, RefusedError
from drivers.interfaces import Vector
from statemachine.runner import StepContext

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
        mover.line(above, plan.speed, TOUCHES)
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
        mover.line(above, plan.speed, TOUCHES)
        raise RefusedError(
            f"{what} sticks, or is heavier than place.contact_force lets the claw lift: it pulled with more than "
            f"{most_pull:.0f} N and let go, at most {1e3 * plan.contact_travel:g} mm above where the part lay. Look "
            "what holds it, or raise place.contact_force",
            Measured("pull at the part", pull, "N", most=most_pull),
        )
    mover.line(above, plan.speed, TOUCHES)
    if pulls and not workplace.devices.claw.holding:
        part.state = PartState.UNKNOWN
        note_part(context, part)
        raise RefusedError("the claw lost the part as it lifted it; look where it fell, and at the fingers")


def _reached(workplace: Workplace, grip: pin.SE3, normal: Vector) -> bool:
    """Whether the open claw came down to `grip` along `normal`, (3,) on the flange, without touching anything."""
    plan, mover = workplace.job.place, workplace.mover
    slow = grip * from_parts(plan.contact_travel * normal)
    if mover.line(slow, plan.speed, TOUCHES, force_limit=FAST_FORCE * plan.contact_force):
        return False
    # What presses already would be taken as zero.
    if not np.linalg.norm(workplace.devices.arm.state().wrench[:3]) <= plan.contact_force:
        return False
    return not mover.line(grip, plan.contact_speed, TOUCHES, force_limit=plan.contact_force)

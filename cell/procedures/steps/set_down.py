"""Set down: the part that was taken from its surface goes into its nest on the vehicle."""

from dataclasses import dataclass, replace

import numpy as np

from cell.measure.inversion import PlacePose
from cell.measure.inversion.part_pose import seen_from_below
from cell.procedures.arm.touch import expected_touch
from cell.procedures.grasp import job_with_grasp
from cell.procedures.steps.pick import HeldPart
from cell.procedures.steps.place import PlaceResult, Placing, note_part
from cell.procedures.steps.workplace import JobStep, Workplace
from drivers.errors import RefusedError
from drivers.interfaces import Vector
from statemachine.runner import StepContext
from statemachine.step import OnFailure, Step


@dataclass(frozen=True, eq=False)
class SetDown:
    """How the part was `put` into its nest. `covariance` (6, 6), m² and rad², is what nest, grip and arm leave open.
    Nobody has looked at the part there."""

    put: PlaceResult
    covariance: Vector

    def summary(self) -> dict[str, object]:
        """Figures for journal and report."""
        told = self.put.summary()
        return {name: told[name] for name in ("contact", "depth_error_mm", "touch", "base_from_flange")}


def _run_step(workplace: Workplace, context: StepContext) -> SetDown:
    nest, part, job = workplace.job.nest, workplace.part_mesh, workplace.job
    assert nest is not None and part is not None
    base_from_part = nest.base_from_part.se3()
    known = np.diag([nest.sigma**2] * 3 + [nest.sigma_angle**2] * 3)
    pose = replace(context.made(PlacePose), base_from_surface=base_from_part, covariance=known)
    held = job_with_grasp(job, job.grasp.flange_from_part.se3(), context.made(HeldPart).covariance)
    below = seen_from_below(part, job.place.surface_from_part.se3())
    placing = Placing(
        held, base_from_part, expected_touch(held, below, pose, workplace.repeatability), mover=workplace.mover,
        arm=workplace.devices.arm, claw=workplace.devices.claw, part=workplace.part, check=context.check,
        progress=context.progress, note=lambda part: note_part(context, part),
    )  # fmt: skip
    try:
        done = placing.put_down()
    except RefusedError as error:
        raise RefusedError(f"at the nest, where [nest] of the job has it: {error}", *error.numbers) from error
    for note in () if done.touch is None else done.touch.notes:
        context.note(text=f"at the nest: {note}")
    return SetDown(done, known + context.made(HeldPart).covariance + workplace.repeatability)


# A part that may have touched its nest is not set down a second time by itself.
STEP = JobStep(Step("set_down", 180.0, on_failure=OnFailure.STOP), _run_step, SetDown, needs=(PlacePose, HeldPart))

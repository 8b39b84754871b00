"""Correction: a part that was placed and seen is gripped again where it lies, and placed anew by what was seen."""

from dataclasses import replace

import pinocchio as pin

from cell.measure.inversion import PlacePose
from cell.measure.inversion.mating import scanned_gap
from cell.procedures.arm.touch import expected_touch
from cell.procedures.grasp import SLIPS, expected_residual, job_with_grasp, moved
from cell.procedures.part_error import part_points
from cell.procedures.steps.pick import take
from cell.procedures.steps.place import PlaceResult, Placing, note_part
from cell.procedures.steps.reconstruct import Reconstruction
from cell.procedures.steps.workplace import Workplace
from drivers.interfaces import Vector
from statemachine.runner import StepContext


def correct(
    workplace: Workplace, placed: PlaceResult, pose: PlacePose, *, held: pin.SE3, slip: pin.SE3, seen: Vector,
    context: StepContext,
) -> PlaceResult:  # fmt: skip
    """Grip the part, with the flange where it was let go, and place it anew; the arm stays above.

    The claw then has it at `held`, flange_from_part, known to `seen` (6, 6). `slip` is how it moves as the claw opens,
    part frame before from part frame after.

    Raises what `Placing.put_down` raises, and `RefusedError` where something is met on the way to the part.
    """
    belongs, points = workplace.job.place.surface_from_part.se3(), part_points(workplace.nominal)
    if moved(slip, points) < SLIPS * expected_residual(workplace.job, workplace.repeatability, pose, points, seen):
        # As little comes of the arm.
        slip = pin.SE3.Identity()
    job = job_with_grasp(workplace.job, held * slip, seen)
    expected = expected_touch(job, workplace.nominal, pose, workplace.repeatability)
    part = workplace.part_mesh
    assert part is not None
    cloud = context.made(Reconstruction).cloud
    # Aimed beside its place, it touches slopes of the surface higher up.
    gap = scanned_gap(cloud, pose.base_from_surface, workplace.nominal, belongs * slip.inverse(), part)
    if gap is not None:
        gap.require(workplace.job.place.tolerance)
        expected = replace(expected, height=expected.height + gap.lift)
    take(workplace, job, placed.base_from_flange, context, what="the placed part", pulls=False)
    placing = Placing(
        job, pose.base_from_surface, expected, mover=workplace.mover, arm=workplace.devices.arm,
        claw=workplace.devices.claw, part=workplace.part, check=context.check, progress=lambda share,
        text: context.progress(0.5, f"again: {text}"), note=lambda part: note_part(context, part),
    )  # fmt: skip
    return replace(placing.put_down(fold=False), look=placed.look, pose=pose, mating=gap)

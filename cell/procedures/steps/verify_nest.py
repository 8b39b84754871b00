"""Verify, after unloading: the part is swept in its nest, and lies there as it should, or the run fails."""

from dataclasses import replace

import numpy as np
import pinocchio as pin

from cell.config.job import Job
from cell.measure.inversion import NominalSurface, PlacePose, Prior, Tolerance
from cell.measure.inversion import invert_pose as register
from cell.measure.inversion.effects.between_sweeps import PartOnGround
from cell.measure.inversion.part_pose import DEMANDS, SHIFTED, PartPose, parted
from cell.measure.inversion.whole_face import unlike_patch
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.part_error import part_points
from cell.procedures.part_features import by_themselves
from cell.procedures.placed_part import NEXT_STEP, PlacedPart
from cell.procedures.sought_part import pose_record
from cell.procedures.steps.invert_pose import slipped
from cell.procedures.steps.laser_sweep import head_at
from cell.procedures.steps.reconstruct import displacements
from cell.procedures.steps.set_down import SetDown
from cell.procedures.steps.verify import swept_part
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.errors import MisplacedError, RefusedError
from statemachine.runner import StepContext
from statemachine.step import OnFailure, Step


def _run_step(workplace: Workplace, context: StepContext) -> PlacedPart:
    job, sweep = where_seen(workplace.job), context.made(SweepRecord)
    belongs = job.place.surface_from_part.se3()
    cloud, swept = swept_part(
        workplace, head_at(workplace, sweep), belongs, context, lying=PartOnGround(workplace.nominal, belongs)
    )
    swept = replace(swept, pointing=sweep.pointing, slip=sweep.slip)
    try:
        fit = part_in_base(workplace, job, workplace.nominal, (cloud, swept))
    except RefusedError as error:
        raise MisplacedError(f"{error}. {NEXT_STEP}", *error.numbers) from error
    stated = context.made(SetDown).covariance
    # The arm's base takes the place of a surface here.
    seen = PartPose(pin.SE3.Identity(), fit.base_from_surface, fit.covariance, fit, beside=fit.n_points)
    found = PlacedPart.of(job, seen, part_points(workplace.nominal), stated)
    own = by_themselves(job, cloud, found.seen, workplace.nominal)
    unlike = unlike_patch(cloud, pin.SE3.Identity(), found.seen.surface_from_part, workplace.nominal)
    found = replace(found, own=own, unlike=unlike, axes="axes of the arm base, in its nest")
    for note in found.notes:
        context.note(text=f"in its nest: {note}")
    if not found.in_tolerance(job.place):
        raise found.misplaced(job.place)
    return found


def part_in_base(workplace: Workplace, job: Job, faces: NominalSurface, swept: tuple[Cloud, SweepRecord]) -> PlacePose:
    """Where the part with these `faces` lies in the arm base, by the sweep of its nest, which is the place of `job`.
    Raises `RefusedError` where it is not seen there."""
    (cloud, record), belongs = swept, job.place.surface_from_part.se3()
    by_calibration, by_poses = displacements(workplace, record, cloud)
    on_part, _ = parted(cloud, faces, belongs)
    if not on_part.valid.any():
        raise RefusedError("the nest is empty: nothing was seen where the part belongs")
    try:
        return register(
            on_part, faces, Prior(belongs, np.diag(SHIFTED**2)),
            Tolerance(job.place.tolerance, job.place.tolerance_angle),
            systematic=workplace.kinematic + slipped(workplace, record), calibration=by_calibration, sweeps=by_poses,
            demands=DEMANDS, partly=True,
        )  # fmt: skip
    except RefusedError as error:
        why = str(error).partition(". ")[0].replace("nominal surface", "drawing of the part")
        why = why.replace("scan and board disagree: the surface", "it").replace("where the board puts it", "there")
        raise RefusedError(f"the part is not seen in its nest: {why}", *error.numbers) from error


def where_seen(job: Job) -> Job:
    """The job with the place where its part is looked at: its own, or the nest of one that unloads."""
    return at_nest(job) if job.unloads else job


def at_nest(job: Job) -> Job:
    """The job with its nest, in the arm base, in the place of its place, with the nest's tolerances."""
    nest = job.nest
    assert nest is not None
    lies = pose_record(nest.base_from_part.se3())
    update = {"surface_from_part": lies, "tolerance": nest.tolerance, "tolerance_angle": nest.tolerance_angle}
    return job.model_copy(update={"place": job.place.model_copy(update=update)})


STEP = JobStep(Step("verify", 900.0, on_failure=OnFailure.STOP), _run_step, PlacedPart, needs=(SweepRecord, SetDown))

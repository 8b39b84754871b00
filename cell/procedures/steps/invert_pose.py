"""Invert the place pose: the nominal surface registered in the cloud, with the board's pose as anchored prior."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pinocchio as pin

from cell.config.job import Job
from cell.measure.geometry.poses import compose_covariance
from cell.measure.inversion import NominalSurface, PlacePose, Prior, Tolerance
from cell.measure.inversion import invert_pose as register
from cell.measure.inversion.effects.causes import find_causes, likeliest
from cell.measure.inversion.effects.during_sweep import (
    Head,
    find_droop,
    find_rocking,
    rocking_covariance,
    rocking_motions,
    roll_of,
    words,
)
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.steps.reconstruct import Reconstruction, together
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.errors import NotObservable, RefusedError
from drivers.interfaces import Vector
from statemachine.runner import StepContext
from statemachine.step import Step


@dataclass(frozen=True, eq=False)
class LineTimes:
    """When each line of the cloud was taken, (lines,) in s, what the arm's base stands on, and the scan head that a
    rail carried, None where the arm did.

    The clock may begin anew with each sweep: nothing is carried over from one to the next.
    """

    times: Vector
    base_from_vehicle: pin.SE3
    head: Head | None = None


def invert_pose(
    scan: Reconstruction, fix: BoardFix, job: Job, nominal: NominalSurface, kinematic: Vector, taken: LineTimes
) -> PlacePose:
    """Where the surface is, in the arm base, with the covariance that stripe, rail, calibration and arm leave it with.

    `kinematic` (6, 6) is the covariance of the place from what the arm's geometry leaves between calibration, sweep and
    placing. The prior is the board's pose carried on to the surface. Raises `RefusedError` when scan, surface and board
    do not fit together or the vehicle rocks too much, `NotObservable` when a direction is not known well enough.
    """
    prior, vehicle = _prior(fix, job), taken.base_from_vehicle
    roll = roll_of(fix.swung, fix.base_from_board, vehicle)
    place = prior.base_from_surface.translation
    unknown = kinematic + rocking_covariance(None, vehicle, place, roll)
    tolerance = Tolerance(job.place.tolerance, job.place.tolerance_angle)
    registered = partial(register, scan.cloud, nominal, prior, tolerance)
    try:
        found = registered(systematic=unknown, calibration=scan.by_calibration, sweeps=scan.by_poses)
    except RefusedError as refused:
        pose = refused.seen.get("pose")
        if not isinstance(pose, pin.SE3) or isinstance(refused, NotObservable):
            raise
        # Never accepted for it: the next likely looks much the same, and the pose would be wrong.
        text = likeliest(find_causes(scan.cloud, nominal, pose, taken.times, taken.base_from_vehicle))
        raise _retold(refused, f"{refused}{text and '. '}{text}".replace("?.", "?")) from refused
    droop = None if taken.head is None else find_droop(scan.cloud, nominal, found.base_from_surface, taken.head)
    by_calibration = scan.by_calibration
    if droop is not None:
        by_calibration = together(by_calibration, partial(droop.motions, scan.cloud))
        try:
            found = registered(systematic=unknown, calibration=by_calibration, sweeps=scan.by_poses)
        except NotObservable as refused:
            raise _retold(refused, f"{refused}. Before: {droop.words}") from refused
        found = replace(found, notes=(droop.words,))
    if (rocking := find_rocking(scan.cloud, nominal, found.base_from_surface, taken.times)) is None:
        return found
    shaken = partial(rocking_motions, scan.cloud, base_from_vehicle=vehicle, times=taken.times, hz=rocking.hz)
    unknown = kinematic + rocking_covariance(rocking, vehicle, place, roll)
    still = registered(systematic=unknown, calibration=by_calibration, sweeps=together(scan.by_poses, shaken))
    return replace(still, notes=(*found.notes, words(rocking)))


def _prior(fix: BoardFix, job: Job) -> Prior:
    """Where the surface is by the board's pose, and by how the job says the surface is mounted beside it."""
    surface = job.surface
    board_from_surface = job.place_from_board.inverse() * surface.place_from_surface.se3()
    mounting = np.diag([surface.prior_sigma**2] * 3 + [surface.prior_sigma_angle**2] * 3)
    spread = compose_covariance(fix.base_from_board, fix.covariance, board_from_surface, mounting)
    return Prior(fix.base_from_board * board_from_surface, spread)


def _retold(refused: RefusedError, text: str) -> RefusedError:
    """The refusal in other words, with its numbers and what was seen."""
    return type(refused)(text, *refused.numbers).showing(seen=refused.seen)


def slipped(workplace: Workplace, sweep: SweepRecord) -> Vector:
    """What a scan head that has slipped, or pictures that come later, may move the place by, (6, 6), base axes."""
    if sweep.slip is None:
        return np.zeros((6, 6))
    camera = sweep.base_from_flange.rotation @ workplace.calibration.scan.flange_from_camera.rotation
    return sweep.slip.covariance(camera, workplace.job.scan.speed)


def inverted(workplace: Workplace, sweep: SweepRecord, scan: Reconstruction, fix: BoardFix) -> PlacePose:
    """`invert_pose` where a job is done."""
    head = None
    if workplace.job.scan.mode == "rail":
        known, travel = workplace.calibration.scan, max(map(abs, workplace.config.rail.travel))
        head = Head.of(scan.cloud, sweep.base_from_flange, known.flange_from_camera, known.rail_direction, travel)
    taken = LineTimes(sweep.times, workplace.config.arm.vehicle_from_base.se3().inverse(), head)
    try:
        return invert_pose(
            scan, fix, workplace.job, workplace.nominal, workplace.kinematic + slipped(workplace, sweep), taken=taken
        )
    except NotObservable as refused:
        if not (notes := (*fix.notes, *sweep.notes)):
            raise
        # What is known too little may be where the laser points, or how the vehicle rocks: no more scanning mends it.
        raise _retold(refused, f"{refused}. Before: {'; '.join(notes)}") from refused


def _run_step(workplace: Workplace, context: StepContext) -> PlacePose:
    sweep, scan, fix = context.made(SweepRecord), context.made(Reconstruction), context.made(BoardFix)
    try:
        found = inverted(workplace, sweep, scan, fix)
    except RefusedError as refused:
        if not workplace.job.unloads:
            raise
        # What is looked for is the part itself.
        why = str(refused).replace("nominal surface", "drawing of the part").replace("right surface", "right part")
        raise _retold(refused, f"the part to be unloaded is not seen where it belongs: {why}") from refused
    for note in found.notes:
        context.note(text=note)
    workplace.registered(found.base_from_surface)
    return found


STEP = JobStep(Step("invert_pose", 60.0, on_wall=True), _run_step, PlacePose, (BoardFix, SweepRecord, Reconstruction))

"""Verify: the placed part and what shows of the surface around it are swept; it lies in its place, or the run fails."""

import math
from dataclasses import replace
from functools import partial

import pinocchio as pin

from cell.config.job import Job
from cell.measure.calibration import ScanCalibration
from cell.measure.calibration.drift.reference_plate import NOTED_RAD
from cell.measure.calibration.drift.slip import NOTED_M
from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface, PlacePose, Prior, Tolerance
from cell.measure.inversion.effects.between_sweeps import GATE_M, LEAST_MOTION_M, PartOnGround
from cell.measure.inversion.flush import flush_along_edge
from cell.measure.inversion.mating import scanned_gap
from cell.measure.inversion.part_pose import find_part, parted, seen_from_above
from cell.measure.inversion.whole_face import unlike_patch
from cell.measure.reconstruction.cloud import Cloud
from cell.measure.reconstruction.ply import write_cloud
from cell.procedures.arm.moves import PartState
from cell.procedures.grasp import FARTHEST_M, expected_residual
from cell.procedures.part_error import part_covariance, part_points
from cell.procedures.part_features import by_themselves
from cell.procedures.placed_part import NEXT_STEP, PlacedPart, along_surface
from cell.procedures.steps.correction import correct
from cell.procedures.steps.laser_sweep import head_at, laser_sweep, seen_on_plate
from cell.procedures.steps.place import PlaceResult, aside_words
from cell.procedures.steps.reconstruct import Reconstruction, build_cloud, displacements, together
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.second_look import moved_meanwhile
from cell.procedures.sweep.stored_sweep import SweepRecord
from cell.procedures.sweep.swath import FRAMES_LOST
from cell.procedures.sweep.sweeping import check_lost_steps
from drivers.errors import DeviceFault, Measured, MisplacedError, RefusedError
from statemachine.runner import StepContext
from statemachine.step import OnFailure, Step

CLOUD = "placed.ply"
SWEPT_AGAIN = (FRAMES_LOST, "rail.late_readings", "arm.late_readings", "camera.late_readings")
"""Faults of a sweep that the next one may not have."""
DOUBTFUL = 20.0
"""χ² of six degrees of freedom from which on a surface that seems to lie elsewhere may be a laser that turned: in 0.3 %
of the sweeps it is chance."""
UNTRUE = "the placed part was not seen where it lies"
SWEEPS = 3
"""How often at most the part is swept until no frames are lost, no replies come too late, and it lies still."""


def _run_step(workplace: Workplace, context: StepContext) -> PlacedPart:
    first = placed = context.made(PlaceResult)
    pose, plan = placed.pose or context.made(PlacePose), workplace.job.place
    found, slips = _looked(workplace, pose, context), list[pin.SE3]()
    leaves = expected_residual(workplace.job, workplace.repeatability, pose, found.points, found.covariance)
    slip = workplace.parts_before.series.slip(found.points, leaves) or pin.SE3.Identity()
    # Along a motion that is not seen it lies where it belongs: that would confirm what was allowed for.
    came = None if found.unseen else along_surface(
        first.allowed * found.belongs.inverse() * found.seen.surface_from_part
    )  # fmt: skip
    for left in range(plan.corrections, 0, -1):
        if not _worth_correcting(workplace, pose, found, left, context):
            break
        context.note(text=f"the placed part lies {found.words}: it is gripped and placed again")
        held = placed.base_from_flange.inverse() * pose.base_from_surface * found.seen.surface_from_part
        try:
            placed = correct(workplace, placed, pose, held=held, slip=slip, seen=found.covariance, context=context)
        except RefusedError as error:
            if workplace.part.state is not PartState.RELEASED:
                raise
            workplace.mover.fold()
            if not found.in_tolerance(plan):
                raise found.misplaced(plan, f"It was not corrected: {error}") from error
            context.note(text=f"it was not corrected: {error}")
            # The claw was near it, and may have moved it.
            found = _looked(workplace, pose, context, found.before)
            break
        for note in placed.notes:
            context.note(text=note)
        found = _looked(workplace, pose, context, (*found.before, found.off))
        # How it was held was seen: what it is off by to the side now came as the claw opened, and comes again.
        let_go = placed.base_from_flange * held
        slip = along_surface(let_go.inverse() * pose.base_from_surface * found.seen.surface_from_part)
        slips.append(slip)
    for note in found.notes:
        context.note(text=note)
    if not found.in_tolerance(plan):
        raise found.misplaced(plan, aside_words(first.allowed, first.parts) if first.parts else "")
    return replace(found, came=came, slips=tuple(slips))


def _worth_correcting(
    workplace: Workplace, pose: PlacePose, found: PlacedPart, left: int, context: StepContext
) -> bool:
    """Whether the part lies farther off than is accepted, and the corrections that are `left` would bring it nearer."""
    plan = workplace.job.place
    if found.off <= (plan.tolerance if plan.accept is None else plan.accept) and found.in_tolerance(plan):
        return False
    known = workplace.job, workplace.repeatability, pose, found.points, found.covariance
    hope = expected_residual(*known, corrections=left)
    why = f"placed again it would be {1e3 * hope:.2f} mm off"
    if found.unlike is not None:
        why = found.unlike.words
    elif found.interference:
        why = found.off_contact_words
    elif found.seen.moved is not None:
        why = "surface or vehicle does not stand where it was swept, and nobody looked where the claw would go"
    elif found.aside >= FARTHEST_M:
        why = f"farther than {1e3 * FARTHEST_M:g} mm the claw may not find it"
    elif not found.in_tolerance(plan) and not found.slipped and not found.not_aside.in_tolerance(plan):
        why = "its height, tilt or edge is what the part lies on, or is, and comes again"
    elif hope < found.aside:
        return True
    context.note(
        text=f"no correction of the placed part, {found.words}: along the surface it is {1e3 * found.aside:.2f} mm "
        f"off; {why}"
    )
    return False


def _looked(
    workplace: Workplace, pose: PlacePose, context: StepContext, before: tuple[float, ...] = ()
) -> PlacedPart:  # fmt: skip
    """Sweep the placed part, which lay `before` so far off, fold the arm, and find the part in the sweep."""
    sweep, scan, part = context.made(SweepRecord), context.made(Reconstruction), workplace.part_mesh
    if part is None:
        raise RefusedError("the job has no mesh of its part ([part]): nothing tells what the placed part looks like")
    place, belongs = workplace.job.place, workplace.job.place.surface_from_part.se3()
    faces, tolerance = seen_from_above(part, belongs), Tolerance(place.tolerance, place.tolerance_angle)
    over = pose.base_from_surface * surface_from_faces(workplace.job, faces)
    lying = PartOnGround(faces, pose.base_from_surface * belongs, (workplace.nominal, pose.base_from_surface))
    cloud, record = swept_part(workplace, head_at(workplace, sweep), over, context, lying=lying)
    record = replace(record, pointing=sweep.pointing, slip=sweep.slip)
    try:
        seen = find_part(
            cloud, faces, workplace.nominal, surface=Prior(pose.base_from_surface, pose.covariance), belongs=belongs,
            tolerance=tolerance, moved=together(*displacements(workplace, record, cloud)), times=record.times,
            base_from_vehicle=workplace.config.arm.vehicle_from_base.se3().inverse(),
        )  # fmt: skip
    except RefusedError as error:
        why = str(error).partition(". ")[0].replace("nominal surface", "drawing of the part")
        raise MisplacedError(
            f"the placed part is not where it was put down, or is not the part as drawn: {why}. {NEXT_STEP}",
            *error.numbers,
        ) from error
    if seen.far > DOUBTFUL or not seen.beside:
        _require_head(workplace, sweep, context)
    stated = part_covariance(workplace.job, pose, workplace.repeatability)
    gap = scanned_gap(scan.cloud, pose.base_from_surface, workplace.nominal, seen.surface_from_part, part)
    on_part, around = parted(cloud, faces, seen.base_from_surface * belongs)
    flush = None if not seen.beside else flush_along_edge(
        on_part, around, seen.base_from_surface, nominal=workplace.nominal, faces=faces, belongs=belongs,
        lies=seen.surface_from_part, tolerance=place.tolerance, rocks=seen.rocked,
    )  # fmt: skip
    found = PlacedPart.of(workplace.job, seen, part_points(workplace.nominal), stated).over(gap, before)
    unlike = unlike_patch(cloud, seen.base_from_surface, found.seen.surface_from_part, faces)
    own = by_themselves(workplace.job, cloud, found.seen, faces)
    return replace(found, flush=flush, own=own, unlike=unlike)


def _require_head(workplace: Workplace, sweep: SweepRecord, context: StepContext) -> None:
    """Raise `MisplacedError` where the plate on the claw shows that laser or scan head has moved since the surface was
    swept: a surface then seems pushed, and a part that hides its surface seems to lie aside."""
    try:
        pointing, slip = seen_on_plate(workplace, context)
    except RefusedError as error:
        raise MisplacedError(f"{UNTRUE}: {error}. {NEXT_STEP}", *error.numbers) from error
    moved = []
    if pointing is not None and sweep.pointing is not None:
        turned = math.dist((pointing.turn, pointing.roll), (sweep.pointing.turn, sweep.pointing.roll))
        moved.append(("laser turned", turned, NOTED_RAD, "mrad"))
    if slip is not None and sweep.slip is not None:
        moved.append(("scan head slipped", math.dist(slip.shift, sweep.slip.shift), NOTED_M, "mm"))
    for what, far, most, unit in moved:
        if far > most:
            raise MisplacedError(
                f"{UNTRUE}: {what} by {1e3 * far:.2f} {unit} since the surface was swept, allowed are {1e3 * most:g} "
                f"{unit}. Look at its screws, then run `cell calibrate`. {NEXT_STEP}",
                Measured(f"{what} since the sweep", 1e3 * far, unit, most=1e3 * most),
            )


def swept_part(
    workplace: Workplace, head: ScanCalibration, over: pin.SE3, context: StepContext, *, frames: str = "verify",
    cloud: str = CLOUD, lying: PartOnGround | None = None,
) -> tuple[Cloud, SweepRecord]:  # fmt: skip
    """Sweep the part `over` what is in the place of the surface, base from there, look whether the rail has lost steps
    meanwhile, and fold the arm. `frames` and `cloud` are what it is kept as. With `lying` the rail's way back looks
    whether the part is at rest: it is swept again until it is, and `MisplacedError` raised for one that is not."""
    while True:
        held = context.held_s
        points, record, moved = _swept_at_rest(workplace, head, over, context, frames=frames, lying=lying)
        write_cloud(workplace.folder / cloud, points, workplace.config.cell.sim)
        context.progress(0.9, "folding the arm, and looking whether the rail has lost steps")
        looking = workplace.devices.rail.check_zero() if workplace.job.scan.mode == "rail" else None
        workplace.mover.fold()
        if looking is not None:
            looking.wait(30.0)
        context.safe_point()
        # Whoever has the run held may reach in, and move the part.
        if context.held_s == held:
            break
    if moved:
        raise MisplacedError(
            f"the placed part does not lie still: in the last of {SWEEPS} sweeps to and fro it moved by "
            f"{1e3 * moved:.3f} mm{' or more' * (moved >= GATE_M)}, allowed are {1e3 * LEAST_MOTION_M:g} mm. It "
            f"slides, sinks or turns, or the vehicle moves: look what both stand on, and what pulls. {NEXT_STEP}",
            Measured("placed part moved from sweep to sweep", 1e3 * moved, "mm", most=1e3 * LEAST_MOTION_M),
        )
    return points, record


def _swept_at_rest(
    workplace: Workplace, head: ScanCalibration, over: pin.SE3, context: StepContext, *, frames: str,
    lying: PartOnGround | None,
) -> tuple[Cloud, SweepRecord, float]:  # fmt: skip
    """The part's cloud and its sweep, made again until it is whole and the part is at rest: nothing of it is moved by
    that. And how far, m, it moved in the last look; 0 for one at rest. Lost steps look like such a motion."""
    for left in reversed(range(SWEEPS)):
        try:
            record = laser_sweep(
                workplace, over, head, workplace.job.scan, check=context.check, counted=False,
                keep_frame=partial(workplace.frames.keep, frames),
                progress=lambda share, text: context.progress(0.85 * share, f"the part: {text}"),
            )  # fmt: skip
            swept = build_cloud(record), record
            moved = 0.0 if lying is None else moved_meanwhile(workplace, head, over, swept, part=lying, context=context)
            if moved and workplace.job.scan.mode == "rail":
                check_lost_steps(workplace.devices, lambda _, text: context.progress(0.85, text))
        except DeviceFault as fault:
            if fault.code not in SWEPT_AGAIN or not left:
                raise
            why = str(fault)
        else:
            if moved is None:
                context.note(text="whether the part lies still was not seen: the last strip hardly shows it")
            if not moved or not left:
                return *swept, moved or 0.0
            why = f"it moved by {1e3 * moved:.3f} mm meanwhile"
        context.note(text=f"the part is swept again: {why}")
    raise AssertionError("the last sweep returns or raises")


def surface_from_faces(job: Job, faces: NominalSurface) -> pin.SE3:
    """The surface's frame, moved up to half the height of the placed part's faces: what the sweep of these is over."""
    middle = job.place.surface_from_part.se3() * (0.5 * sum(faces.extent))
    return from_parts((0.0, 0.0, middle[2]))


# What was interrupted with the part between the fingers is left to a person. A correction takes up to 300 s.
STEP = JobStep(
    Step("verify", 3600.0, on_failure=OnFailure.STOP), _run_step, PlacedPart,
    needs=(SweepRecord, Reconstruction, PlacePose, PlaceResult),
)  # fmt: skip

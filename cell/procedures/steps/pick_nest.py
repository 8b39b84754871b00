"""Pick from the nest: the part is found by its mesh where it lies on the vehicle, gripped there, felt, and lifted."""

from dataclasses import replace

from cell.measure.geometry.poses import from_parts
from cell.measure.inversion.part_pose import seen_from_above
from cell.procedures.arm.moves import PartState
from cell.procedures.grasp import job_with_grasp, moved
from cell.procedures.part_error import part_points
from cell.procedures.steps.drive_to_target import VehicleArrival
from cell.procedures.steps.laser_sweep import seen_on_plate
from cell.procedures.steps.pick import HeldPart, take
from cell.procedures.steps.verify import swept_part
from cell.procedures.steps.verify_nest import at_nest, part_in_base
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.sweeping import home_rail
from drivers.errors import Measured, RefusedError
from statemachine.runner import StepContext
from statemachine.step import OnFailure, Step

CLOUD = "nest.ply"


def _run_step(workplace: Workplace, context: StepContext) -> HeldPart:
    held = (
        workplace.held
        if workplace.held is not None and workplace.part.state is PartState.HELD
        else _picked(workplace, context)
    )
    workplace.job = job_with_grasp(workplace.job, workplace.job.grasp.flange_from_part.se3(), held.covariance)
    workplace.held = held
    return held


def _picked(workplace: Workplace, context: StepContext) -> HeldPart:
    job, part, arrival = at_nest(workplace.job), workplace.part_mesh, context.made(VehicleArrival)
    assert part is not None
    if workplace.part.state is not PartState.NESTED:
        raise RefusedError(f"the part is {workplace.part.state.value}: nothing is gripped a second time")
    belongs = job.place.surface_from_part.se3()
    # The arm moves beside the station from here on, and about the part.
    workplace.mover.avoid_station(arrival.base_from_place, workplace.job, workplace.board, workplace.nominal.extent)
    workplace.mover.avoid_part(belongs, job.grasp.size)
    home_rail(workplace.devices, context.progress)
    head, look = workplace.calibration.scan, workplace.look_before(context)
    pointing, slip = (look.pointing, look.slip) if look is not None else seen_on_plate(workplace, context)
    if pointing is not None:
        head = head.pointed(pointing, workplace.config.laser.exit_point)
    faces = seen_from_above(part, belongs)
    low, high = faces.extent
    over = belongs * from_parts((0.0, 0.0, 0.5 * float(low[2] + high[2])))
    cloud, swept = swept_part(workplace, head, over, context, frames="nest", cloud=CLOUD)
    fit = part_in_base(workplace, job, faces, (cloud, replace(swept, pointing=pointing, slip=slip)))
    off = 1e3 * moved(belongs.inverse() * fit.base_from_surface, part_points(faces))
    most = 1e3 * job.place.tolerance
    if not off <= most:
        raise RefusedError(
            f"the part lies {off:.2f} mm off its place in the nest, on average (allowed: {most:g} mm): the fingers may "
            "not hold it as they should. Put it right, or correct nest.base_from_part",
            Measured("part off its place in the nest", off, "mm", most=most),
        )
    context.note(text=f"the part lies {off:.2f} mm off its place in the nest, and is gripped where it lies")
    grip = fit.base_from_surface * workplace.job.grasp.flange_from_part.se3().inverse()
    workplace.part.where = fit.base_from_surface
    take(workplace, workplace.job, grip, context, what="the part")
    held = HeldPart(grip, fit.covariance + workplace.repeatability)
    context.note(part=workplace.part.state.value, held=held.as_dict())
    return held


# What was interrupted as the claw closed is left to a person.
STEP = JobStep(Step("pick", 600.0, on_failure=OnFailure.STOP), _run_step, HeldPart, needs=(VehicleArrival,))

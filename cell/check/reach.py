"""Whether the arm reaches every pose of a job and of a calibration without touching anything, as drawn, and whether a
sweep can see how the part lies once it was placed."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import CellConfig, deck_plates, mounted, station_obstacles, vehicle_obstacles
from cell.config.job import Job
from cell.measure.calibration import ScanCalibration
from cell.measure.calibration.solve.results import PARAMETERS, Quality
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface, Tolerance
from cell.measure.inversion.part_pose import seen_from_above, shown_by
from cell.measure.vision.board.view import centre_of, parse_board
from cell.motion.collision import (
    TOUCHES,
    CollisionError,
    CollisionModel,
    Pair,
    arm_bodies,
    station_bodies,
    tool_bodies,
    vehicle_bodies,
)
from cell.motion.kinematics import HOME, Unreachable, arm_kinematics
from cell.motion.planning import Planner
from cell.procedures.arm import photograph
from cell.procedures.arm.moves import ROOM_ABOVE, nested_parts, placed_parts
from cell.procedures.steps.verify import surface_from_faces
from cell.procedures.sweep.sweeping import RUN_UP_S
from drivers.errors import ConfigError
from drivers.interfaces import Vector

Goal = tuple[str, pin.SE3, tuple[Pair, ...]]
"""What a pose is for, the pose base_from_flange, and which bodies may touch there."""


def reach_problems(
    job: Job, config: CellConfig, extent: tuple[Vector, Vector], *, calibrates: bool = False
) -> Iterator[str]:
    """A line for each of the poses, as drawn, that the arm cannot take. `extent` is the box around the surface, m. The
    calibration's views are taken with an empty claw, or with the job's part in it if this job `calibrates`."""
    kinematics = arm_kinematics(config.arm.model, None)
    arm = arm_bodies(config.arm.model)
    deck = [*vehicle_bodies(deck_plates(config)), *vehicle_obstacles(config.obstacle)]
    part = tool_bodies(job.grasp.size, job.grasp.flange_from_part.se3(), mounted(config))
    tool = part if calibrates else tool_bodies(None, None, mounted(config))
    yield from _unreached(Planner(kinematics, CollisionModel(kinematics, [*arm, *tool, *deck])), _views(config))
    held = station_planner(job, config, extent)
    try:
        held.collisions.require_free(HOME, "arm folded, with the part of grasp.size")
    except CollisionError as error:
        yield str(error)
        return
    yield from _unreached(held, _goals(job, config))


def station_planner(job: Job, config: CellConfig, extent: tuple[Vector, Vector]) -> Planner:
    """The arm as drawn, with the job's part in its claw, at the job's station. `extent` as in `reach_problems`."""
    kinematics = arm_kinematics(config.arm.model, None)
    deck = [*vehicle_bodies(deck_plates(config)), *vehicle_obstacles(config.obstacle)]
    part = tool_bodies(job.grasp.size, job.grasp.flange_from_part.se3(), mounted(config))
    board = job.place_from_board * from_parts(centre_of(parse_board(job.board.spec)))
    x, y, z = extent[1].tolist()
    station = station_bodies(
        photograph.base_from_place_at_target(config, job), board, job.surface.place_from_surface.se3(),
        (extent[0].tolist(), (x, y, z + ROOM_ABOVE)),
    )  # fmt: skip
    station += station_obstacles(job.obstacle, photograph.base_from_place_at_target(config, job))
    others = [*nested_parts(job), *placed_parts(job, photograph.base_from_place_at_target(config, job))]
    bodies = [*arm_bodies(config.arm.model), *part, *deck, *station, *others]
    return Planner(kinematics, CollisionModel(kinematics, bodies))


def sweep_problems(job: Job, config: CellConfig, extent: tuple[Vector, Vector]) -> Iterator[str]:
    """The same for the ends of the job's sweeps alone."""
    surface = photograph.base_from_place_at_target(config, job) * job.surface.place_from_surface.se3()
    yield from _unreached(station_planner(job, config, extent), _sweeps(job, config, surface))


def nominal_scan(config: CellConfig) -> ScanCalibration:
    """The scan head as drawn, for planning only: its covariance is zero, its quality empty."""
    laser, size = config.laser, len(PARAMETERS)
    return ScanCalibration(
        nominal_camera(config.scan_camera), LightPlane.from_baseline(laser.baseline, float(np.arctan(laser.tan_theta))),
        np.array([1.0, 0.0, 0.0]), flange_from_camera=config.scan_camera.flange_from_camera.se3(),
        covariance=np.zeros((size, size)),
        quality=Quality(0, 0.0, 0.0, stripe_rms=None, held_out_px=0.0, held_out_stripe=None),
    )  # fmt: skip


def _views(config: CellConfig) -> Iterator[Goal]:
    deck = config.calibration
    for k, view in enumerate(photograph.scan_calibration_views(config, parse_board(deck.fine.board))):
        yield f"calibration view {k + 1} of calibration.fine", view.base_from_flange, ()
    for k, view in enumerate(photograph.target_calibration_views(config, parse_board(deck.large.board))):
        yield f"calibration view {k + 1} of calibration.large", view.base_from_flange, ()


def _goals(job: Job, config: CellConfig) -> Iterator[Goal]:
    """The poses of a job in their order, with the vehicle at its target."""
    board = parse_board(job.board.spec)
    base_from_place = photograph.base_from_place_at_target(config, job)
    camera = config.target_camera.flange_from_camera.se3()
    yield "the looking pose (photo.look_down, photo.stand_off)", photograph.look_pose(config, job, board, camera), ()
    photo = photograph.photo_pose(job, board, base_from_place * job.place_from_board, camera)
    yield "the photograph's pose (board.place_from_board, photo.stand_off)", photo, ()
    surface = base_from_place * job.surface.place_from_surface.se3()
    yield from _sweeps(job, config, surface)
    part = surface * job.place.surface_from_part.se3()
    part_from_flange = job.grasp.flange_from_part.se3().inverse()
    for what, height, touching in (
        ("the pose above the place (place.approach)", job.place.approach, ()),
        ("the place pose (place, surface)", -job.place.contact_travel, TOUCHES),
    ):
        yield what, part * from_parts((0.0, 0.0, height)) * part_from_flange, touching
    if job.nest is not None:
        below = job.place.contact_travel if job.unloads else 0.0
        for what, height in (("above the nest", job.place.approach), ("in the nest", -below)):
            nest = job.nest.base_from_part.se3() * from_parts((0.0, 0.0, height))
            yield f"the pose {what} (nest.base_from_part)", nest * part_from_flange, ()
        yield from _sweeps(job, config, job.nest.base_from_part.se3(), over="the part in its nest")
        if job.unloads:
            return
    try:
        faces = seen_faces(job)
    except ConfigError:
        # Told with what else is wrong with the part.
        return
    if faces is not None:
        yield from _sweeps(job, config, surface * surface_from_faces(job, faces), over="the placed part")


def seen_faces(job: Job) -> NominalSurface | None:
    """The faces of the part that are looked at once it was placed; None where nobody looks. Raises `ConfigError` where
    it has none, or its mesh is none."""
    if job.part is None or job.place.verify == "none":
        return None
    part = NominalSurface.load(Path(job.part.mesh), unit=job.part.mesh_unit)
    return seen_from_above(part, job.place.surface_from_part.se3())


def _sweeps(job: Job, config: CellConfig, base_from_surface: pin.SE3, over: str = "scan, surface") -> Iterator[Goal]:
    for k, plan in enumerate(photograph.scan_plans(config, job, base_from_surface, nominal_scan(config))):
        way = plan.base_from_flange_end.translation - plan.base_from_flange.translation
        run_up = RUN_UP_S * job.scan.speed * way / max(float(np.linalg.norm(way)), 1e-9)
        yield f"the begin of sweep {k + 1} ({over})", from_parts(-run_up) * plan.base_from_flange, ()
        yield f"the end of sweep {k + 1} ({over})", from_parts(run_up) * plan.base_from_flange_end, ()


def _unreached(planner: Planner, goals: Iterator[Goal]) -> Iterator[str]:
    """At most three lines: what follows from one wrong pose need not be told for each."""
    joints, told = HOME, 0
    for what, goal, allowed in goals:
        try:
            joints = planner.reach(goal, joints, what, allowed)
        except Unreachable as error:
            yield f"{what}: {error}"
        except CollisionError as error:
            yield str(error)
        else:
            continue
        told += 1
        if told == 3:
            return


def verify_problems(job: Job, config: CellConfig) -> Iterator[str]:
    """What keeps a sweep from seeing the placed part; nothing where nobody looks."""
    try:
        faces = seen_faces(job)
    except ConfigError as error:
        yield str(error)
        return
    if faces is None or job.part is None:
        return
    name, (low, high) = Path(job.part.mesh).name, faces.extent
    half, camera, laser = 0.5 * float(high[2] - low[2]), config.scan_camera, config.laser
    nearest = job.scan.stand_off - half
    column = camera.focal_length / camera.pixel * (1 / laser.tan_theta - laser.baseline / max(nearest, 1e-3))
    if abs(column) > 0.5 * camera.width:
        yield (
            f'part.mesh "{name}": the faces of the placed part span {2e3 * half:.0f} mm of height; from scan.stand_off '
            f"{1e3 * job.scan.stand_off:g} mm the laser's line on the highest leaves the scan camera's picture. Raise "
            'scan.stand_off, or write place.verify = "none"'
        )
    tolerance = Tolerance(job.place.tolerance, job.place.tolerance_angle)
    if job.place.verify == "all" and (unseen := shown_by(faces, tolerance)):
        yield (
            f'part.mesh "{name}": the faces of the placed part do not show {", ".join(unseen)}. Write place.verify = '
            '"seen" to have the rest looked at, or "none"'
        )

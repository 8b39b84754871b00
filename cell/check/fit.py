"""Whether a job fits a cell, told before anything moves: speeds and times, pictures, and what `cell.fit_*` add.

Everything is reckoned with the geometry as drawn. What stands some millimetres beside the drawing is found on the way.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.check.place import contact_problems, mating_problems, mesh_box, place_problems, surface_problems, way_problems
from cell.check.reach import reach_problems, verify_problems
from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import CALIBRATION_DEPTHS, CellConfig
from cell.config.job import Job, item_names, load_job
from cell.measure.geometry.poses import transform
from cell.measure.vision.board.view import BoardSpec, centre_of, parse_board
from cell.measure.vision.stripe_on_board import MARGIN_PITCHES
from cell.motion.collision import tool_bodies, vehicle_bodies
from cell.procedures.arm.photograph import look_pose
from cell.procedures.drive.driving import Planar
from cell.procedures.drive.way import Way, left_at
from cell.procedures.sought_part import around, ground_below, nominal_of, sought
from cell.procedures.steps import pick, pick_nest, verify
from cell.procedures.steps.kinds import kind_of
from drivers.errors import ConfigError, RefusedError
from drivers.make import CameraConfig

RAMP_MARGIN = 0.0005
"""What the rail's driver adds to each ramp of a sweep, m."""
PLATE = (0.21, 0.17)
"""Size of the station's board in the collision check, m."""
LEAST_PITCH_PX = 8.0
HIGHEST_PLATE = 0.3
"""How high above the deck a calibration board may be, m."""
LEVEL, LEVEL_ANGLE = 0.001, math.radians(0.5)
"""How even the floor between two stops is drawn, m and rad."""
ON_LINE, ON_LINE_ANGLE = 0.05, math.radians(5)
"""So near to the line, m and rad, a vehicle from another stop comes to its staging pose."""
LONGEST_DRIVE_S, LONGEST_DESCENT_S = 150.0, 150.0
"""The steps that drive and place have 180 s."""


def require_fit(job: Job, config: CellConfig, mesh: Path, *, calibrates: bool = False) -> None:
    """Raise `ConfigError` when the job asks for more than the cell may do or can reach; nothing has moved yet.

    `mesh` is the file of the job's nominal surface. With `calibrates` the cell may be calibrated first, as a simulated
    one is, with the part in its claw. All problems are told at once, a line each.
    """
    problems = [
        *_kind(job), *_speeds(job, config), *_boards(job, config), *_plates(config), *_cameras(config),
        *way_problems(job, config), *place_problems(job),
    ]  # fmt: skip
    problems = problems or [*_sight(job, config), *_stops(job, config)]
    extent = mesh_box(mesh, job.surface.mesh_unit)
    problems += [*surface_problems(job, extent, mesh), *_stripe(job, config, extent[0][2], extent[1][2])]
    # The arm's poses follow from the others: where these are wrong, it would only be told twice.
    if not problems:
        found, file = sought(job, mesh)
        box = extent if found is job else around(nominal_of(found, file).extent, ground_below(job, extent))
        problems += reach_problems(found, config, box, calibrates=calibrates)
    problems += contact_problems(job, config, mesh)
    problems = problems or [*mating_problems(job, mesh), *verify_problems(job, config)]
    if problems:
        raise ConfigError(f"job {job.job.name} does not fit this cell:\n  " + "\n  ".join(problems))


def read_fitting(name: str | Path, config: CellConfig, *, calibrates: bool = False) -> tuple[Job, Path]:
    """The job of this file or name, or its first item, and the file of its surface's mesh. Raises `ConfigError` where
    it does not fit the cell, or one of its items does not."""
    read = [load_job(item) for item in item_names(name)]
    for job, mesh in read:
        require_fit(job, config, mesh, calibrates=calibrates)
    return read[0]


def _kind(job: Job) -> Iterator[str]:
    try:
        kind = kind_of(job)
    except ConfigError as error:
        yield str(error)
        return
    unloads, loads = pick.STEP in kind.steps, pick_nest.STEP in kind.steps
    if (unloads or loads) and (job.part is None or job.nest is None):
        yield f'job.kind "{kind.name}" finds the part by its mesh and has a nest for it: give [part] and [nest]'
    if unloads and job.place.verify == "none":
        yield f'place.verify = "none": job.kind "{kind.name}" looks at the part in its nest; write "all" or "seen"'
    if job.nest is not None and not (unloads or loads):
        yield f'[nest]: job.kind "{kind.name}" has no use for it; write kind = "load" or "unload", or no nest'
    if job.part is None and verify.STEP.name in kind.names:
        yield f'job.kind "{kind.name}" looks at the placed part: give its mesh in [part]'


def _speeds(job: Job, config: CellConfig) -> Iterator[str]:
    scan, rail, arm = job.scan, config.rail, config.arm
    by_rail = scan.mode == "rail"
    ramps = scan.speed**2 / rail.acceleration + 2 * RAMP_MARGIN
    room = rail.travel[1] - rail.travel[0]
    if by_rail and scan.length + ramps > room:
        yield (
            f"scan.length {1e3 * scan.length:g} mm and its ramps of {1e3 * ramps:.2f} mm exceed rail.travel, "
            f"{1e3 * room:g} mm"
        )
    fastest = (rail.max_speed, "rail.max_speed") if by_rail else (arm.max_tool_speed, "arm.max_tool_speed")
    speeds = [
        ("scan.speed", scan.speed, *fastest),
        ("place.speed", job.place.speed, arm.max_tool_speed, "arm.max_tool_speed"),
    ]
    if config.vehicle.DRIVES:
        speeds.insert(1, ("approach.speed", job.approach.speed, config.vehicle.max_speed, "vehicle.max_speed"))
    for name, asked, allowed, limit in speeds:
        if asked > allowed:
            yield f"{name} {1e3 * asked:g} mm/s exceeds {limit}, {1e3 * allowed:g} mm/s"
    poses = [pose.se3().translation for pose in (job.approach.start, job.approach.staging, job.approach.target)]
    way = float(np.linalg.norm(poses[1] - poses[0]) + np.linalg.norm(poses[2] - poses[1])) * config.vehicle.DRIVES
    descent = 2 * job.place.approach / job.place.speed + 2 * job.place.contact_travel / job.place.contact_speed
    for what, time, longest, remedy in (
        (f"the way of {way:.2f} m at approach.speed", way / job.approach.speed, LONGEST_DRIVE_S, "approach.speed"),
        ("place.approach and place.contact_travel at their speeds", descent, LONGEST_DESCENT_S, "place.speed"),
    ):
        if time > longest:
            yield f"{what} takes {time:.0f} s (allowed: at most {longest:.0f} s); raise {remedy}"


def _boards(job: Job, config: CellConfig) -> Iterator[str]:
    """Boards of which the order is seen, that fill neither more nor too little of the pictures that are taken."""
    station = parse_board(job.board.spec)
    size = _size(station)
    if size[0] > PLATE[0] or size[1] > PLATE[1]:
        yield (
            f"board.spec {station.name} is {1e3 * size[0]:g} x {1e3 * size[1]:g} mm with its rim, larger than the "
            f"plate of {1e3 * PLATE[0]:g} x {1e3 * PLATE[1]:g} mm of the collision check; take a smaller board"
        )
    deck = config.calibration
    for key, board, camera, name, depth in (
        ("board.spec", station, config.target_camera, "target_camera", job.photo.stand_off),
        ("calibration.fine.board", parse_board(deck.fine.board), config.scan_camera, "scan_camera",
         CALIBRATION_DEPTHS["fine"][1]),
        ("calibration.large.board", parse_board(deck.large.board), config.target_camera, "target_camera",
         CALIBRATION_DEPTHS["large"][1]),
    ):  # fmt: skip
        if board.symmetric:
            yield f"{key} {board.name} looks the same when it is turned by half a turn; take marked_dots or charuco"
        if camera is config.scan_camera and board.kind not in MARGIN_PITCHES:
            yield f"{key} {board.name}: no stripe is read on it; take a board of these: {', '.join(MARGIN_PITCHES)}"
        yield from _in_picture(key, board, camera, name, depth)


def _sight(job: Job, config: CellConfig) -> Iterator[str]:
    """The board has to be seen with the arm in its looking pose, from staging to target while the vehicle drives."""
    board, camera = parse_board(job.board.spec), nominal_camera(config.target_camera)
    hand = config.target_camera.flange_from_camera.se3()
    vehicle_from_camera = config.arm.vehicle_from_base.se3() * look_pose(config, job, board, hand) * hand
    stands = {"staging": job.approach.staging, "target": job.approach.target}
    if not config.vehicle.DRIVES:
        del stands["staging"]
    for name, stand in stands.items():
        camera_from_board = (stand.se3() * vehicle_from_camera).inverse() * job.place_from_board
        points = transform(camera_from_board, board.points())
        middle = points.mean(axis=0)
        pixels = camera.project(points)
        slant = math.acos(min(1.0, float(camera_from_board.rotation[:, 2] @ middle / np.linalg.norm(middle))))
        where = f"with the vehicle at approach.{name} and the arm in its looking pose"
        # A point behind the camera has no pixel, and a comparison with none is false.
        if not ((pixels >= 0) & (pixels <= (camera.width - 1, camera.height - 1))).all():
            yield (
                f"{where}, the board is not in the target camera's picture; change photo.look_down, photo.stand_off, "
                f"board.place_from_board or approach.{name}"
            )
        elif slant > job.photo.max_obliquity:
            yield (
                f"{where}, the board is seen {math.degrees(slant):.0f} deg from square, more than photo.max_obliquity, "
                f"{math.degrees(job.photo.max_obliquity):.0f} deg"
            )


@dataclass
class _AsDrawn:
    """A vehicle that stands as drawn; see `cell.procedures.drive.way.Reckoned`."""

    stands: Planar
    way: float = 0.0
    turned: float = 0.0

    def pose(self) -> Planar:
        """Where it stands."""
        return self.stands


def _stops(job: Job, config: CellConfig) -> Iterator[str]:
    """The vehicle comes, as drawn, from every other stop to that of this item."""
    if job.stop and not config.vehicle.DRIVES:
        yield "[[stop]]: the arm stands on a fixed frame, which drives to no other stop; leave the stops out"
        return
    staging = Planar.of(job.approach.staging.se3())
    for stop in job.other_stops:
        where = f"from stop {stop.name} to stop {job.at_stop}"
        there = stop.place_from_stop * stop.approach.target.se3()
        step = float(there.translation[2] - job.approach.target.se3().translation[2])
        if abs(step) > LEVEL or there.rotation[2, 2] < math.cos(LEVEL_ANGLE):
            yield (
                f"stop.place_from_stop: {where} the floor rises by {-1e3 * step:.0f} mm or is tilted; stops have one "
                f"level floor (allowed: {1e3 * LEVEL:g} mm, {math.degrees(LEVEL_ANGLE):g} deg)"
            )
            continue
        drawn = _AsDrawn(Planar.of(there))
        way = Way(job, config.arm.vehicle_from_base.se3(), drawn)
        try:
            back = way.require_line(left_at(stop))
            drawn.stands, drawn.way = back, math.hypot(back.x - drawn.stands.x, back.y - drawn.stands.y)
            beside = staging.inverse() * way.require_line(staging)
        except RefusedError as refused:
            yield f"{where}: {refused}. As drawn; change stop.place_from_stop or the start of its approach"
            continue
        if abs(beside.y) > ON_LINE or abs(beside.yaw) > ON_LINE_ANGLE:
            yield (
                f"{where}: at approach.staging the vehicle is still {1e3 * beside.y:.0f} mm beside the line, turned by "
                f"{math.degrees(beside.yaw):.0f} deg (allowed: {1e3 * ON_LINE:g} mm, "
                f"{math.degrees(ON_LINE_ANGLE):.0f} deg); give it a longer way: an earlier approach.start there, or a "
                "later approach.staging here"
            )
        if (time := way.longest / job.approach.speed) > LONGEST_DRIVE_S:
            yield f"{where} takes {time:.0f} s (allowed: at most {LONGEST_DRIVE_S:.0f} s); raise approach.speed"


def _in_picture(key: str, board: BoardSpec, camera: CameraConfig, name: str, depth: float) -> Iterator[str]:
    per_metre = camera.focal_length / camera.pixel / depth
    width, height = (per_metre * side for side in _size(board))
    where = f"{key} {board.name} at {1e3 * depth:g} mm from {name}"
    if width > camera.width or height > camera.height:
        yield (
            f"{where} takes {width:.0f} x {height:.0f} pixels of {camera.width} x {camera.height}; take a smaller "
            "board or a larger distance"
        )
    if (pitch := per_metre * board.pitch) < LEAST_PITCH_PX:
        yield f"{where}: its points are {pitch:.1f} pixels apart (allowed: at least {LEAST_PITCH_PX:g}); go nearer"


def _plates(config: CellConfig) -> Iterator[str]:
    """The calibration's boards lie on the vehicle's deck, the plate on the claw where the rail takes the camera."""
    deck = vehicle_bodies()[0]
    half = 0.5 * np.array(deck.size[:2])
    top = float(deck.placement.translation[2]) + 0.5 * deck.size[2]
    (low, high), witness = config.rail.travel, config.laser.witness
    if witness is not None and not low <= witness <= high:
        yield (
            f"laser.witness {1e3 * witness:g} mm is outside rail.travel, {1e3 * low:g} to {1e3 * high:g} mm: from "
            "there the camera sees the line on the plate on the claw"
        )
    for name in ("fine", "large"):
        plate = getattr(config.calibration, name)
        centre = plate.base_from_board.se3() * centre_of(parse_board(plate.board))
        beside = np.abs(centre[:2] - deck.placement.translation[:2]) - half
        if beside.max() > 0 or not -0.01 <= centre[2] - top <= HIGHEST_PLATE:
            shown = ", ".join(f"{1e3 * v:.0f}" for v in centre)
            yield (
                f"calibration.{name}.base_from_board puts the board's middle at ({shown}) mm in the arm's base, "
                f"which is not on the deck (allowed: over it, up to {1e3 * HIGHEST_PLATE:g} mm high)"
            )


def _cameras(config: CellConfig) -> Iterator[str]:
    """A camera looks from beside the claw, not from inside it."""
    claw = tool_bodies()[0]
    for name in ("scan_camera", "target_camera"):
        place = getattr(config, name).flange_from_camera.se3().translation
        if (np.abs(claw.placement.actInv(place)) <= 0.5 * np.array(claw.size)).all():
            yield f"{name}.flange_from_camera puts the camera into the claw; write where it is mounted on the flange"


def _size(board: BoardSpec) -> tuple[float, float]:
    """Width and height of the points with half a pitch around them, m."""
    width, height = np.ptp(board.points()[:, :2], axis=0) + board.pitch
    return float(width), float(height)


def _stripe(job: Job, config: CellConfig, low: float, high: float) -> Iterator[str]:
    """The laser's line has to be in the picture at every depth at which it is looked for."""
    camera, laser = config.scan_camera, config.laser
    surface = [job.scan.stand_off - height for height in (high, low)]
    if surface[0] <= 0:
        yield (
            f"surface.mesh is {1e3 * high:g} mm high, the scan camera only scan.stand_off "
            f"{1e3 * job.scan.stand_off:g} mm above its origin; correct surface.mesh_unit or raise scan.stand_off"
        )
        return
    nearest, _, farthest = CALIBRATION_DEPTHS["fine"]
    for what, depths in (("the surface, at scan.stand_off", surface), ("calibration", [nearest, farthest])):
        for depth in depths:
            column = camera.focal_length / camera.pixel * (1 / laser.tan_theta - laser.baseline / depth)
            if abs(column) > 0.5 * camera.width:
                crossing = laser.baseline * laser.tan_theta
                yield (
                    f"the laser's line is not in the scan camera's picture in {what} ({1e3 * depth:.0f} mm away): by "
                    f"laser.baseline and laser.tan_theta it crosses the picture's middle at {1e3 * crossing:.0f} mm, "
                    f"and leaves it {math.floor(abs(column) - 0.5 * camera.width) + 1} pixels behind its edge"
                )
                break

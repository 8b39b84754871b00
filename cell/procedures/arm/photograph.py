"""A photograph of the station's board as its pose in the arm's base, and where the cameras have to be.

Poses for looking, photographing, scanning and calibrating are pure geometry. Whether the arm can reach them is
`cell.motion`'s business.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import reduce

import numpy as np
import pinocchio as pin
import scipy

from cell.config.cell_config import CellConfig
from cell.config.job import Job, PhotoSection
from cell.measure.calibration import ScanCalibration, TargetCalibration
from cell.measure.calibration.drift.evidence import CHECKED_LARGE_VIEW, CHECKED_VIEW, INTERIM_VIEW, Reference
from cell.measure.geometry.poses import compose_covariance, from_parts, from_ur, mean, transform
from cell.measure.inversion.effects.during_sweep import require_firm, roll_of
from cell.measure.vision.board.board import BoardPose, board_pose, find_board
from cell.measure.vision.board.view import BoardSpec, BoardView, centre_of, parse_board
from drivers.errors import CalibrationStale, Measured, RefusedError
from drivers.interfaces import Arm, Camera, Frame, Vector

NO_REFERENCE = (
    "the stored calibration holds no reference to verify against, it was made by an older program; run "
    "`cell calibrate` once"
)
MOVED = 22.46
"""Squared Mahalanobis distance of two board poses above which the station has moved: χ² of 6 at 0.999."""

NEAR = 2e-3
"""So near its pose, m, and rad, the arm photographs from where it rests: the board looks the same from there."""


@dataclass(frozen=True, eq=False)
class BoardFix:
    """The board in the arm's base; `covariance` (6, 6) in the base, translation then rotation, m and rad.

    `views` are the points found in each of the `frames`; by ±`swung` m the board moved between them, 0 where that does
    not show. `notes` are for people. `flange` (6,) and `joints` (6,) are what the arm told meanwhile;
    `number` counts a run's photographs.
    """

    base_from_board: pin.SE3
    covariance: Vector
    residual_px: float
    obliquity: float
    frames: tuple[Frame, ...]
    views: tuple[BoardView, ...] = ()
    swung: float = 0.0
    notes: tuple[str, ...] = ()
    flange: Vector = field(default_factory=lambda: np.zeros(6))
    joints: Vector = field(default_factory=lambda: np.zeros(6))
    number: int = 0
    by_mount: Vector = field(default_factory=lambda: np.zeros((6, 6)))

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            "residual_px": round(self.residual_px, 4), "obliquity_deg": round(math.degrees(self.obliquity), 2),
            "sigma_mm": [round(1e3 * s, 4) for s in sigma[:3]], "sigma_mrad": [round(1e3 * s, 4) for s in sigma[3:]],
            "swung_mm": round(1e3 * self.swung, 4),
        }  # fmt: skip


def photograph(
    arm: Arm, camera: Camera, calibration: TargetCalibration, spec: BoardSpec, limits: PhotoSection,
    repeatability: Vector, count: int = 1, keep: Callable[[Frame], None] = lambda frame: None,
    pause: Callable[[], None] = lambda: None,
) -> BoardFix:  # fmt: skip
    """Photograph the board `count` times with arm and vehicle at rest and average its pose.

    `repeatability` is the (6, 6) covariance of base_from_flange; `keep` is given each frame before it is looked at;
    `pause` is called between two.
    Raises `RefusedError` with the reason: board not found, seen more obliquely than `limits.max_obliquity`, residual
    above `limits.max_residual`, or pose ambiguous; it shows the "frame" and the "view", as far as there is one.
    """
    stands = arm.state()
    base_from_flange = from_ur(stands.flange)
    frames: list[Frame] = []
    for k in range(count):
        if k:
            pause()
        frames.append(camera.grab())
        keep(frames[-1])
    views: list[BoardView] = []
    poses: list[BoardPose] = []
    for frame in frames:
        view = None
        try:
            view = find_board(frame.image, spec)
            pose = board_pose(view, calibration.camera)
            _require(pose, limits)
        except RefusedError as refused:
            refused.showing(seen={"frame": frame, "view": view})
            raise
        views.append(view)
        poses.append(pose)
    obliquity = max(pose.obliquity for pose in poses)
    residual = max(pose.rms_px for pose in poses)
    camera_from_board = mean([pose.camera_from_board for pose in poses])
    base_from_camera = base_from_flange * calibration.flange_from_camera
    hand_eye = compose_covariance(
        base_from_flange, repeatability, calibration.flange_from_camera, calibration.hand_eye_covariance
    )
    covariance = compose_covariance(
        base_from_camera, hand_eye, camera_from_board, np.mean([pose.covariance for pose in poses], axis=0) / count
    )
    mount = compose_covariance(
        base_from_flange, nothing := np.zeros((6, 6)), calibration.flange_from_camera, calibration.hand_eye_covariance
    )
    by_mount = compose_covariance(base_from_camera, mount, camera_from_board, nothing)
    centre = transform(camera_from_board, views[0].object_points.mean(axis=0)[None])[0]
    swung = swing(views, float(centre[2]) / calibration.camera.fx)
    seen = base_from_camera * camera_from_board, covariance, residual, obliquity
    return BoardFix(
        *seen, tuple(frames), tuple(views), swung, flange=stands.flange, joints=stands.joints, by_mount=by_mount
    )


# A vehicle that has just stopped, or that somebody leans on, rocks on its tyres by a tenth of a milliradian and more, a
# few times a second. The arm's base rocks with it, and what was seen a moment ago is not where it was.

APART_S = 0.07
"""Between two photographs: four of them are spread over the period of the few hertz at which vehicles rock."""
CHANCE = 1e-5
"""Of taking a board that stands still for one that does not."""
LEAST_M = 20e-6
"""What a board goes to and fro less than this is not worth waiting for."""


def swing(views: Sequence[BoardView], metres_per_px: float) -> float:
    """By how much, m, to either side the board moves between photographs from one place; 0 where nothing shows it. The
    mean place of the points that all of them show tells it: what lens and board are off by is the same in each."""
    if len(views) < 2:
        return 0.0
    shared = reduce(np.intersect1d, [view.ids for view in views])
    if not len(shared):
        return 0.0
    means, variances = [], []
    for view in views:
        here = np.isin(view.ids, shared)
        means.append(view.pixels[here].mean(axis=0))
        variances.append(float(np.mean(view.sigma[here] ** 2)) / len(shared))
    squares = float(np.sum((np.array(means) - np.mean(means, axis=0)) ** 2))
    free = len(views) - 1
    if squares < float(np.mean(variances)) * scipy.special.chdtri(2 * free, CHANCE):
        return 0.0
    # Of a sine along a line the mean square is half that of its height.
    found = float(np.sqrt(2.0 * squares / free)) * metres_per_px
    return found if found > LEAST_M else 0.0


def swing_covariance(swung: float, base_from_board: pin.SE3, base_from_vehicle: pin.SE3) -> Vector:
    """Covariance (6, 6), m² and rad², base axes, of a board that goes to and fro by `swung` m as the vehicle rocks.
    Raises `RefusedError` when it rocks too much to put anything down."""
    angle = roll_of(swung, base_from_board, base_from_vehicle)
    require_firm(angle, swung, "the board")
    return np.diag([0.5 * swung**2] * 3 + [0.5 * angle**2] * 3)


def _require(pose: BoardPose, limits: PhotoSection) -> None:
    if not pose.obliquity <= limits.max_obliquity:
        seen, allowed = math.degrees(pose.obliquity), math.degrees(limits.max_obliquity)
        raise RefusedError(
            f"the board is seen {seen:.1f} deg from square, allowed up to {allowed:.0f} deg; photograph it from "
            "further in front",
            Measured("board, from square", seen, "deg", most=allowed),
        )
    if not pose.rms_px <= limits.max_residual:
        raise RefusedError(
            f"the board's dots miss their places by {pose.rms_px:.3g} px RMS, allowed up to {limits.max_residual:.3g} "
            "px; is the target camera still in focus and calibrated, and the board flat?",
            Measured("board's dots off their places, RMS", pose.rms_px, "px", most=limits.max_residual),
        )


@dataclass(frozen=True)
class ScanPlan:
    """A planned sweep: where the flange begins and ends, in the base, and the rail positions at these two places.
    Between them the velocity is constant. Either the flange stands still, or the rail."""

    base_from_flange: pin.SE3
    base_from_flange_end: pin.SE3
    rail_start: float
    rail_stop: float

    @property
    def back(self) -> "ScanPlan":
        """The same way in the other direction."""
        return ScanPlan(self.base_from_flange_end, self.base_from_flange, self.rail_stop, self.rail_start)


@dataclass(frozen=True)
class CalibrationView:
    """A calibration view: the flange's pose in the base and, for the camera on the rail, the rail's position."""

    base_from_flange: pin.SE3
    rail_position: float


def base_from_place_at_target(config: CellConfig, job: Job) -> pin.SE3:
    """Nominal pose of the place frame in the arm's base once the vehicle stands at its target."""
    return (job.approach.target.se3() * config.arm.vehicle_from_base.se3()).inverse()


def facing(board: BoardSpec, base_from_board: pin.SE3, stand_off: float) -> pin.SE3:
    """base_from_camera that looks square at the board's centre from `stand_off` m, image x along the board's x."""
    return base_from_board * from_parts(centre_of(board)) * from_parts((0.0, 0.0, -stand_off))


def look_pose(config: CellConfig, job: Job, board: BoardSpec, flange_from_camera: pin.SE3) -> pin.SE3:
    """base_from_flange for driving: the target camera looks ahead and down and sees the board all along."""
    base_from_board = base_from_place_at_target(config, job) * job.place_from_board
    place = transform(facing(board, base_from_board, job.photo.stand_off), np.zeros(3))
    down = job.photo.look_down
    forward = np.array([np.cos(down), 0.0, -np.sin(down)])
    right = np.array([0.0, -1.0, 0.0])
    base_from_camera = from_parts(place, np.column_stack([right, np.cross(forward, right), forward]))
    return base_from_camera * flange_from_camera.inverse()


def photo_pose(job: Job, board: BoardSpec, base_from_board: pin.SE3, flange_from_camera: pin.SE3) -> pin.SE3:
    """base_from_flange that puts the target camera square in front of the board."""
    return facing(board, base_from_board, job.photo.stand_off) * flange_from_camera.inverse()


def scan_plans(
    config: CellConfig, job: Job, base_from_surface: pin.SE3, calibration: ScanCalibration
) -> list[ScanPlan]:
    """The job's sweeps, each along the surface's x axis over its own part of the surface.

    The scan camera looks along the surface's −z from the stand-off, image x along the surface's x, turned about the
    middle of what it scans. The rail is in the middle of its travel half-way, or all along when the arm moves the head.
    """
    low, high = config.rail.travel
    middle, half = 0.5 * (low + high), 0.5 * job.scan.length
    by_arm = job.scan.mode == "arm"
    if not by_arm and job.scan.length > high - low:
        raise ValueError(
            f"scan.length {job.scan.length * 1e3:g} mm exceeds the rail's travel {1e3 * (high - low):g} mm"
        )
    normal, distance = np.array(calibration.light_plane.normal), calibration.light_plane.distance
    stripe_x = (distance - normal[2] * job.scan.stand_off) / normal[0]
    head = from_parts((-stripe_x, 0.0, job.scan.stand_off), np.diag([1.0, -1.0, -1.0]))
    plans = []
    for swath in job.scan.swath:
        turn = pin.rpy.rpyToMatrix(swath.roll, swath.pitch, 0.0)
        centre = base_from_surface * from_parts((0.0, swath.across, 0.0), turn)
        camera_from_flange = calibration.flange_from_camera_at(middle).inverse()
        if by_arm:
            ends = [centre * from_parts((x, 0.0, 0.0)) * head * camera_from_flange for x in (-half, half)]
            plans.append(ScanPlan(ends[0], ends[1], middle, middle))
        else:
            stand = centre * head * camera_from_flange
            plans.append(ScanPlan(stand, stand, middle - half, middle + half))
    return plans


def scan_calibration_views(config: CellConfig, board: BoardSpec) -> list[CalibrationView]:
    """Views of the fine deck board for the scan camera: depths, tilts, turns, all of the field and of the rail."""
    base_from_board = config.calibration.fine.base_from_board.se3()
    views = []
    for k in range(len(_SCAN_VIEWS)):
        rail = _scan_rail(config, k)
        flange_from_camera = config.scan_camera.flange_from_camera.se3() * from_parts((rail, 0.0, 0.0))
        views.append(
            CalibrationView(_looking(base_from_board, board, _SCAN_VIEWS[k]) * flange_from_camera.inverse(), rail)
        )
    return views


def target_calibration_views(config: CellConfig, board: BoardSpec) -> list[CalibrationView]:
    """Views of the large deck board for the target camera: several distances and tilts, and all of the field."""
    base_from_board = config.calibration.large.base_from_board.se3()
    camera_from_flange = config.target_camera.flange_from_camera.se3().inverse()
    return [
        CalibrationView(_looking(base_from_board, board, drawn) * camera_from_flange, 0.0) for drawn in _TARGET_VIEWS
    ]


def references(scan: ScanCalibration, target: TargetCalibration) -> tuple[Reference, Reference]:
    """What both cameras' calibrations are verified against. Raises `CalibrationStale` where that was not stored."""
    if scan.reference is None or target.reference is None:
        raise CalibrationStale(NO_REFERENCE)
    return scan.reference, target.reference


def verification_views(
    config: CellConfig, fine: BoardSpec, large: BoardSpec, scan: ScanCalibration, target: TargetCalibration
) -> tuple[CalibrationView, CalibrationView]:
    """One of the scan camera's calibration views and one of the target camera's.

    The first is aimed with what the calibration found: as drawn the board may lie half out of the picture. The rail
    stands near its middle, so that it can move both ways. For the second the arm stands where it stood. Raises
    `CalibrationStale` for a calibration that was stored without its reference.
    """
    near, far = references(scan, target)
    if (known := far.pictures.get(CHECKED_LARGE_VIEW)) is not None:
        eye = CalibrationView(known.base_from_flange, 0.0)
    else:
        base_from_target = _looking(far.base_from_board, large, _TARGET_VIEWS[_numbered(CHECKED_LARGE_VIEW)])
        eye = CalibrationView(base_from_target * target.flange_from_camera.inverse(), 0.0)
    return _scan_view(config, fine, scan, near, CHECKED_VIEW), eye


def interim_view(config: CellConfig, fine: BoardSpec, scan: ScanCalibration) -> CalibrationView:
    """One of the scan camera's calibration views, for the look of each job: just where the arm stood for it.

    The rail stands near its zero, from which a sweep begins. Of the views where it does, this one's own kinematic error
    is least: 0.014 mm an axis in 16 simulated cells, where another's was 0.027. Raises `CalibrationStale` as
    `verification_views`.
    """
    if scan.reference is None:
        raise CalibrationStale(NO_REFERENCE)
    return _scan_view(config, fine, scan, scan.reference, INTERIM_VIEW)


def drawn_interim_view(config: CellConfig) -> CalibrationView:
    """The same as drawn, for who has no calibration at hand."""
    return scan_calibration_views(config, parse_board(config.calibration.fine.board))[_numbered(INTERIM_VIEW)]


def _scan_view(
    config: CellConfig, fine: BoardSpec, scan: ScanCalibration, near: Reference, view: str
) -> CalibrationView:  # fmt: skip
    if (known := near.pictures.get(view)) is not None:
        return CalibrationView(known.base_from_flange, known.rail)
    rail = _scan_rail(config, k := _numbered(view))
    base_from_scan = _looking(near.base_from_board, fine, _SCAN_VIEWS[k])
    return CalibrationView(base_from_scan * scan.flange_from_camera_at(rail).inverse(), rail)


def _numbered(view: str) -> int:
    return int(view.split()[1]) - 1


def rail_ends(
    scan: ScanCalibration, base_from_board: pin.SE3, view: CalibrationView, board: BoardSpec,
    travel: tuple[float, float],
) -> tuple[float, float]:  # fmt: skip
    """The rail positions farthest either way of a view at which the picture shows the rings and half of the dots.
    Raises `RefusedError` when they are less than `LEAST_WAY` apart."""
    points, radius = board.points(), board.dot_radius
    rings = [row * board.cols + column for column, row in board.rings]
    size = np.array([scan.camera.width, scan.camera.height])

    def shown(rail: float) -> bool:
        if not travel[0] <= rail <= travel[1]:
            return False
        base_from_camera = view.base_from_flange * scan.flange_from_camera_at(rail)
        seen = transform(base_from_camera.inverse() * base_from_board, points)
        room = EDGE_PX + scan.camera.fx * radius / seen[:, 2:]
        pixels = scan.camera.project(seen)
        inside = np.logical_and(pixels > room, pixels < size - 1 - room).all(axis=1)
        return bool(np.take(inside, rings).all() and np.mean(inside) >= LEAST_DOTS)

    ends = []
    for way in (-RAIL_STEP, RAIL_STEP):
        rail = view.rail_position
        while shown(rail + way):
            rail += way
        ends.append(rail)
    if ends[1] - ends[0] < LEAST_WAY:
        raise RefusedError(
            f"the fine board stays in the scan camera's picture for {1e3 * (ends[1] - ends[0]):.0f} mm of the rail's "
            f"way, a verification needs at least {1e3 * LEAST_WAY:.0f} mm: run `cell calibrate`, or see that "
            "calibration.fine.base_from_board and scan_camera.flange_from_camera are as built"
        )
    return ends[0], ends[1]


def _scan_rail(config: CellConfig, k: int) -> float:
    """Where the rail stands in the scan camera's view `k`, m: each view elsewhere, all of the travel but its ends."""
    low, high = config.rail.travel
    return low + (high - low) * (0.1 + 0.8 * ((k * 5) % len(_SCAN_VIEWS)) / (len(_SCAN_VIEWS) - 1))


def _looking(base_from_board: pin.SE3, board: BoardSpec, drawn: Sequence[float]) -> pin.SE3:
    """base_from_camera for a line of the tables of views."""
    along, across, depth, *turns = drawn
    rotation = pin.rpy.rpyToMatrix(*np.deg2rad(turns))
    centre = base_from_board * from_parts(centre_of(board))
    return centre * from_parts(np.zeros(3), rotation) * from_parts(1e-3 * np.array([along, across, -depth]))


EDGE_PX, LEAST_DOTS, RAIL_STEP, LEAST_WAY = 12.0, 0.5, 1e-3, 0.02

# Offset of the optical axis along and across the board in mm, depth in mm, tilts about x and y and turn about z in deg.
_SCAN_VIEWS: tuple[tuple[float, float, float, float, float, float], ...] = (
    (0, 0, 130, 0, 0, 0),
    (4, 2, 124, 20, 0, 0),
    (-4, -2, 142, -28, 0, 0),
    (4, -2, 135, 0, 28, 10),
    (-4, 2, 125, 0, -28, -10),
    (0, 3, 120, 15, 20, 25),
    (0, -3, 142, -20, 20, -25),
    (5, 0, 138, 15, -20, 40),
    (-5, 0, 124, -20, -20, -40),
    (2, 2, 130, 20, 0, 90),
    (-2, -2, 130, -28, 0, 90),
    (2, -2, 128, 0, 28, 70),
    (-2, 2, 138, 0, -28, 70),
    (5, 3, 132, 12, 22, -20),
    (-5, -3, 128, -12, -22, 20),
    (5, -3, 140, 20, -10, 0),
    (-5, 3, 124, -25, 10, 0),
    (0, 0, 120, 0, 0, 45),
    (3, 0, 142, 0, 25, -60),
    (-3, 0, 136, -28, 0, 60),
)
_TARGET_VIEWS: tuple[tuple[float, float, float, float, float, float], ...] = (
    (0, 0, 650, 0, 0, 0),
    (90, 60, 620, 15, 0, 0),
    (-90, -60, 600, -15, 0, 0),
    (90, -60, 640, 0, 18, 0),
    (-90, 60, 600, 0, -18, 0),
    (0, 0, 560, 12, 12, 30),
    (0, 0, 700, -12, 12, -30),
    (60, 0, 680, 15, -12, 20),
    (-60, 0, 580, -15, -12, -20),
    (0, 50, 640, 20, 0, 45),
    (0, -50, 640, -20, 0, -45),
    (100, 0, 600, 0, 15, 15),
)

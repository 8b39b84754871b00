"""A scan head of any size, drawn from a seed, what it would observe of a board and a surface, and its calibrations.

The true head is the simulator's (its optics project, its light plane cuts); the estimators only get the observations
with noise. Frames: the camera's at rail position 0 for scans, the arm's base for boards.
"""

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from cell.measure.calibration import ScanCalibration, ScanObservation
from cell.measure.calibration.solve.joint import solve_joint, solve_staged
from cell.measure.calibration.solve.results import KEPT, Quality
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import from_parts, perturbed
from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.vision.board.view import BoardView, centre_of, parse_board
from lab.bench.calibration.world import Noise, centroids, circle, profile_of
from sim_backends.optics import Board, BoardInstance, CameraOptics, LaserOptics, Mesh, MeshInstance
from sim_backends.optics.laser.sheet import lit
from sim_backends.optics.laser.stripe import crossings
from sim_backends.world.levels import deviations


def from_axes(translation: ArrayLike, x: ArrayLike, z: ArrayLike) -> pin.SE3:
    """Pose whose x and z axes are given in the outer frame; they must be perpendicular. Translation in m."""
    xs, zs = np.asarray(x, dtype=np.float64), np.asarray(z, dtype=np.float64)
    xs, zs = xs / np.linalg.norm(xs), zs / np.linalg.norm(zs)
    if abs(xs @ zs) > 1e-6:
        raise ValueError(f"axes must be perpendicular; x·z is {xs @ zs:.3g}")
    return from_parts(translation, np.column_stack([xs, np.cross(zs, xs), zs]))


Array = NDArray[np.float64]
NOMINAL_MOUNT = from_axes((0.09, -0.05, 0.08), x=(0, 1, 0), z=(0, 0, 1))
RIM = 64
"""Points on the rim of a dot from which its image's centre is found."""
Indices = NDArray[np.intp]

DIRECTIONS = 300
"""Directions, evenly over the sphere, over which the mean length of a Gaussian error is taken."""


@dataclass(frozen=True)
class RigSpec:
    """The drawing of a scan head: m, px; `meeting` is where light plane and optical axis meet. `depths` (nearest,
    farthest) are where the board is shown, `travel` is the rail's, `views` the calibration's poses."""

    width: int = 640
    height: int = 480
    pixel: float = 4.8e-6
    focal: float = 8e-3
    baseline: float = 0.035
    meeting: float = 0.1225
    depths: tuple[float, float] = (0.118, 0.145)
    travel: float = 0.1
    views: int = 20
    board: str = "marked_dots:11x9:3mm"
    noise: Noise = field(default_factory=Noise)

    @property
    def theta(self) -> float:
        """The angle between baseline and light plane, rad."""
        return float(np.arctan2(self.meeting, self.baseline))

    def nominal_camera(self) -> CameraModel:
        """The camera of the drawing."""
        f = self.focal / self.pixel
        return CameraModel(self.width, self.height, f, f, (self.width - 1) / 2, (self.height - 1) / 2)

    def nominal(self) -> ScanGeometry:
        """The head as drawn, not calibrated."""
        plane = LightPlane.from_baseline(self.baseline, self.theta)
        return ScanGeometry(self.nominal_camera(), plane, np.array([1.0, 0.0, 0.0]), NOMINAL_MOUNT)

    def as_dict(self) -> dict[str, float | int | str | list[float]]:
        """For reports, in mm and µm."""
        return {
            "sensor_px": f"{self.width} × {self.height}", "pixel_um": 1e6 * self.pixel, "focal_mm": 1e3 * self.focal,
            "baseline_mm": 1e3 * self.baseline, "light_plane_meets_axis_mm": 1e3 * self.meeting,
            "depths_mm": [1e3 * z for z in self.depths], "rail_travel_mm": 1e3 * self.travel,
            "calibration_views": self.views, "board": self.board,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class TrueHead:
    """What the head really is; `rail_direction` (3,) is the camera's travel per metre of reading."""

    optics: CameraOptics
    laser: LaserOptics
    rail_direction: Array
    flange_from_camera: pin.SE3


def draw_head(spec: RigSpec, rng: np.random.Generator, level: str = "nominal") -> TrueHead:
    """A head that differs from its drawing as the simulated cell's does at a level. ValueError for an unknown one."""
    n = deviations(level)

    def draw(sigma: float, size: int) -> Array:
        return sigma * np.clip(rng.standard_normal(size), -2.5, 2.5)

    focal = spec.focal / spec.pixel * (1 + draw(n.focal_length, 1)[0])
    shift = draw(n.principal_point, 2)
    k1, k2 = draw(n.distortion_k1, 2)
    p1, p2 = draw(0.02 * n.distortion_k1, 2)
    optics = CameraOptics(
        spec.width, spec.height, focal, focal * (1 + 0.04 * draw(n.focal_length, 1)[0]),
        (spec.width - 1) / 2 + shift[0], (spec.height - 1) / 2 + shift[1], (k1, 0.5 * k2, p1, p2, 0.0),
        pixel=spec.pixel, focal=spec.focal, focus_distance=spec.meeting, read_noise_dn=n.read_noise,
        transmission=0.4,
    )  # fmt: skip
    plain = np.array([1.0, 0.0, -spec.baseline / spec.meeting])
    normal = pin.exp3(draw(n.light_plane_tilt, 3)) @ (plain / np.linalg.norm(plain))
    origin = np.array([-spec.baseline, 0.0, 0.0]) + draw(n.light_plane_offset, 3)
    laser = LaserOptics(
        origin=(float(origin[0]), float(origin[1]), float(origin[2])),
        normal=(float(normal[0]), float(normal[1]), float(normal[2])),
        distance=float(normal @ origin),
        speckle_contrast=n.speckle_contrast,
    )
    direction = (1 + draw(n.rail_lead, 1)[0]) * (pin.exp3(draw(n.rail_direction, 3)) @ np.array([1.0, 0.0, 0.0]))
    moved = np.concatenate([draw(n.hand_eye_translation, 3), draw(n.hand_eye_rotation, 3)])
    return TrueHead(optics, laser, direction, perturbed(NOMINAL_MOUNT, moved))


def arm_error(noise: Noise, rng: np.random.Generator) -> Array:
    """(6,) m and rad: how far the flange stands off what the arm reports, anew at each pose."""
    return np.concatenate([noise.arm / np.sqrt(3) * rng.standard_normal(3), noise.arm_angle * rng.standard_normal(3)])


def dot_centres(optics: CameraOptics, camera_from_board: pin.SE3, board: Board) -> Array:
    """Centres (n, 2) px of the dots' images: centroids of their projected rims."""
    ring = board.dot_radius * circle(RIM)
    rims = (board.points[:, None] + ring).reshape(-1, 3) @ camera_from_board.rotation.T + camera_from_board.translation
    return centroids(optics.project(rims).reshape(-1, RIM, 2))


def observe(spec: RigSpec, head: TrueHead, rng: np.random.Generator) -> list[ScanObservation]:
    """The calibration's views: board and stripe at `spec.views` poses over depths, tilts, turns and rail positions."""
    board, known = Board.parse(spec.board), parse_board(spec.board)
    field = spec.depths[0] * np.array([spec.width, spec.height]) * spec.pixel / spec.focal
    base_from_board = perturbed(from_axes((-0.55, 0.25, 0.02), x=(1, 0, 0), z=(0, 0, -1)), 0.004 * rng.normal(size=6))
    made = []
    for k in range(spec.views):
        tilt = np.radians(rng.uniform(10, 40)) * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.0])
        rotation = pin.exp3(tilt) @ pin.exp3(np.array([0.0, 0.0, rng.uniform(-0.4, 0.4)]))
        centre = np.array([*(rng.uniform(-0.1, 0.1, 2) * field), rng.uniform(*spec.depths)])
        seen = from_parts(centre - rotation @ centre_of(known), rotation)
        reading = rng.uniform(0.0, spec.travel)
        flange = (
            base_from_board * (head.flange_from_camera * from_parts(reading * head.rail_direction) * seen).inverse()
        )
        pixels = dot_centres(head.optics, seen, board)
        pixels = pixels + spec.noise.dots * rng.standard_normal(pixels.shape)
        ids = np.flatnonzero(((pixels > 12) & (pixels < (spec.width - 13, spec.height - 13))).all(axis=1))
        view = BoardView(
            known, (spec.width, spec.height), ids, pixels[ids], np.full(len(ids), spec.noise.dots),
            dot_radius=known.dot_radius,
        )  # fmt: skip
        found = crossings(head.optics, head.laser, BoardInstance(seen.homogeneous, board))
        columns = np.full(spec.height, np.nan)
        columns[found.rows] = found.columns + spec.noise.stripe * rng.standard_normal(len(found.rows))
        columns[(columns < 5) | (columns > spec.width - 6)] = np.nan
        made.append(
            ScanObservation(
                view,
                profile_of(columns, spec.noise.stripe, 2.0),
                perturbed(flange, arm_error(spec.noise, rng)),
                reading + spec.noise.rail * rng.standard_normal(),
            )
        )
    return made


@dataclass(frozen=True, eq=False)
class Sweep:
    """One sweep: noisy stripe `centres` (lines, rows) px, NaN for holes, `readings` (lines,) m of the rail, and the
    `truth` (lines, rows, 3): the lit points in m, camera frame at rail position 0."""

    centres: Array
    readings: Array
    truth: Array


def sweep(
    spec: RigSpec, head: TrueHead, mesh: Mesh, camera_from_mesh: pin.SE3, readings: Array, rng: np.random.Generator
) -> Sweep:
    """Sweep a surface at `camera_from_mesh` (camera at rail position 0), a profile at each true rail position."""
    centres = np.full((len(readings), spec.height), np.nan)
    truth = np.full((len(readings), spec.height, 3), np.nan)
    for line, reading in enumerate(readings):
        offset = reading * head.rail_direction
        pose = camera_from_mesh.homogeneous.copy()
        pose[:3, 3] -= offset
        instance = MeshInstance(pose, mesh)
        found = crossings(head.optics, head.laser, instance)
        found = found.keep(lit(found.points, found.normals, instance, [instance], head.laser))
        found = found.keep((found.columns > 5) & (found.columns < spec.width - 6))
        centres[line, found.rows] = found.columns + spec.noise.stripe * rng.standard_normal(len(found.rows))
        truth[line, found.rows] = found.points + offset
    measured = np.asarray(readings) + spec.noise.rail * rng.standard_normal(len(readings))
    return Sweep(centres, measured, truth)


@dataclass(frozen=True, eq=False)
class Solved:
    """The three geometries and the calibration of the joint one, which carries the covariance."""

    nominal: ScanGeometry
    staged: ScanGeometry
    joint: ScanGeometry
    calibration: ScanCalibration

    def ways(self) -> dict[str, ScanGeometry]:
        """By name, in the order of a table."""
        return {"nominal": self.nominal, "staged": self.staged, "joint": self.joint}


def solve(spec: RigSpec, observations: list[ScanObservation]) -> Solved:
    """Calibrate with the product's own estimators."""
    staged = solve_staged(observations, spec.nominal_camera(), np.array([1.0, 0.0, 0.0]))
    joint = solve_joint(observations, staged, spec.noise.priors, held_out=False)
    state = joint.adjusted.state
    assert staged.plane is not None and state.plane is not None
    hand = staged.hand_eye
    calibration = ScanCalibration(
        state.camera, state.plane, state.rail_direction, state.flange_from_camera,
        joint.adjusted.covariance[:KEPT, :KEPT], Quality.of(joint),
    )  # fmt: skip
    return Solved(
        spec.nominal(), ScanGeometry(staged.camera, staged.plane.plane, hand.rail_direction, hand.flange_from_camera),
        calibration.geometry(), calibration,
    )  # fmt: skip


def in_scan_frame(geometry: ScanGeometry) -> ScanGeometry:
    """The same head without its mount: its points are in the camera's frame at rail position 0."""
    return ScanGeometry(geometry.camera, geometry.light_plane, geometry.rail_direction, pin.SE3.Identity())


def expected_length(covariances: Array) -> float:
    """Mean over points of the mean length in m of a Gaussian error with each of the `covariances` (n, 3, 3) in m². A
    standard normal vector is a length of mean √(8/π) times an independent direction u, so E‖A g‖ = √(8/π) E‖A u‖."""
    k = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - 2 * k / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - height**2)
    directions = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    squares = np.einsum("di,nij,dj->nd", directions, covariances, directions)
    return float(np.sqrt(8 / np.pi) * np.sqrt(np.maximum(squares, 0.0)).mean())


def point_covariances(
    spec: RigSpec, geometry: ScanGeometry, variants: list[ScanGeometry], pixels: Array, rail: Array
) -> Array:
    """Covariances (n, 3, 3) in m² of points from calibration, stripe and rail noise, in the geometry's own frame."""
    points, by_pixel = geometry.solve(pixels, rail)
    spread = [variant.solve(pixels, rail)[0] - points for variant in variants]
    along = np.broadcast_to(geometry.flange_from_camera.rotation @ geometry.rail_direction, points.shape)
    columns = np.stack([*spread, by_pixel[:, :, 0] * spec.noise.stripe, along * spec.noise.rail], axis=2)
    return np.asarray(columns @ columns.transpose(0, 2, 1))


def aligned(found: Array, truth: Array) -> Array:
    """What is left (n, 3) of found − truth after the rigid motion of the found points that is best in least squares."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    return np.asarray(Rotation.align_vectors(b, a)[0].apply(a) - b, dtype=np.float64)

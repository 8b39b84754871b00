"""Observations of a drawn world without its pictures: dots and stripes from the simulator's optics, with stated noise.

For campaigns over many worlds. Projection, light plane, arm and every deviation are the simulator's; nothing here comes
from the estimators, so that an error cannot cancel. Rendering and picture processing are left out: their noise is
stated here, as measured on rendered pictures.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.config.calibrations.store import CellCalibration, gathered, solve_observations
from cell.config.cell_config import CellConfig
from cell.measure.calibration import ScanObservation, TargetObservation
from cell.measure.geometry.poses import from_matrix
from cell.measure.vision.board.view import BoardSpec, BoardView, centre_of, parse_board
from cell.measure.vision.stripe.profile import StripeProfile
from cell.motion.kinematics import HOME, Joints, arm_kinematics
from cell.procedures.arm.photograph import CalibrationView, scan_calibration_views, target_calibration_views
from cell.procedures.calibrate.boards import RAIL_MOVE, RAIL_MOVE_VIEWS
from drivers.interfaces import LinkTable
from lab.bench.calibration.world import circle, profile_of
from sim_backends.models.arm_kinematics import UR10E_DH, Kinematics
from sim_backends.optics.camera import CameraOptics
from sim_backends.world import drawing
from sim_backends.world.drawing import inverse
from sim_backends.world.scene import Scene, rotation

Array = NDArray[np.float64]

EDGE_PX = 12.0
RIM = 24
DOTS_PX, STRIPE_PX = 0.03, 0.07
"""One standard deviation of what picture processing adds: of a dot and of a stripe centre per row, px."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What a verification could find changed. Poses are (4, 4); lenses are fx, fy, cx, cy, k1, k2, p1, p2, k3.

    `rail_direction` (3,) is the camera's travel in its own axes in m per m of rail reading; the light plane is
    `plane_normal`·P = `plane_distance` in the scan camera's frame.
    """

    scan_lens: Array
    target_lens: Array
    plane_normal: Array
    plane_distance: float
    rail_direction: Array
    flange_from_scan: Array
    flange_from_target: Array
    base_from_fine: Array
    base_from_large: Array

    @classmethod
    def of(cls, scene: Scene) -> "Truth":
        """The truth of a drawn world."""
        scan, target = scene.scan_lens, scene.target_lens
        return cls(
            np.array([scan.fx, scan.fy, scan.cx, scan.cy, *scan.dist]),
            np.array([target.fx, target.fy, target.cx, target.cy, *target.dist]), scene.light_plane_normal,
            scene.light_plane_distance, scene.rail_direction * (1.0 + scene.rail_lead_error),
            scene.flange_from_scan_camera, scene.flange_from_target_camera, scene.base_from_fine_board,
            scene.base_from_deck_board,
        )  # fmt: skip


@dataclass(eq=False)
class Rest:
    """The arm at rest: where it says that the flange is, and where it is, (4, 4) both."""

    reported: Array
    true: Array


@dataclass(eq=False)
class ObservedCell:
    """One world that is observed as a cell observes it. `rng` draws everything that differs from time to time."""

    scene: Scene
    config: CellConfig
    rng: np.random.Generator
    bend: float = 0.0
    """Sagitta in m of the fine board, bent along its x about its middle."""

    def __post_init__(self) -> None:
        self.truth = Truth.of(self.scene)
        told = UR10E_DH + self.scene.dh_factory
        a, d, alpha, theta = (tuple(column) for column in told.T.tolist())
        self._told = arm_kinematics("UR10e", LinkTable(theta, a, d, alpha))
        self._true = Kinematics(told + self.scene.dh_error)
        self._joints: Joints = HOME
        self.fine = parse_board(self.config.calibration.fine.board)
        self.large = parse_board(self.config.calibration.large.board)

    def move(self, base_from_flange: Array) -> Rest:
        """Bring the arm to rest at a pose (4, 4): what it reports, and where it truly came to rest."""
        self._joints = self._told.ik(from_matrix(base_from_flange), self._joints)
        sigma = self.scene.deviations
        drawn = self.rng.normal(size=6)
        true = self._true.forward(self._joints)
        true[:3, 3] += sigma.arm_repeatability / np.sqrt(3.0) * drawn[:3]
        true[:3, :3] = rotation(sigma.arm_repeatability_rotation * drawn[3:]) @ true[:3, :3]
        return Rest(self._told.fk(self._joints).homogeneous, true)

    def carriage(self, reading: float) -> float:
        """Where the carriage stands for a rail reading, both in m: backlash from either side, periodic error, homing.
        The lead's error is in `Truth.rail_direction`."""
        scene = self.scene
        side = 0.5 * scene.rail_backlash * self.rng.choice((-1.0, 1.0))
        periodic = scene.rail_periodic_amplitude * np.sin(2 * np.pi * reading / 0.002 + scene.rail_periodic_phase)
        return float(reading + side + periodic + scene.deviations.rail_homing * self.rng.normal())

    def scan_view(self, rest: Rest, carriage: float) -> BoardView:
        """The fine board in a photograph of the scan camera."""
        seen = self._camera_from(rest, self.truth.base_from_fine, carriage)
        return self._photo(seen, self.truth.scan_lens, drawing.SCAN_SIZE, self.fine, self.bend)

    def target_view(self, rest: Rest) -> BoardView:
        """The large board in a photograph of the target camera."""
        seen = inverse(rest.true @ self.truth.flange_from_target) @ self.truth.base_from_large
        return self._photo(seen, self.truth.target_lens, drawing.TARGET_SIZE, self.large)

    def stripe(self, rest: Rest, carriage: float) -> StripeProfile:
        """The laser's stripe on the fine board's plate, one centre per image row."""
        truth = self.truth
        seen = self._camera_from(rest, truth.base_from_fine, carriage)
        width, height = drawing.SCAN_SIZE
        size = np.ptp(self.fine.points()[:, :2], axis=0) + 2 * self.fine.pitch
        normal, at = seen[:3, 2], seen[:3, 3]
        along = np.cross(truth.plane_normal, normal)
        system = np.array([truth.plane_normal, normal, along / np.linalg.norm(along)])
        middle = seen[:3, :3] @ centre_of(self.fine) + at
        foot = np.linalg.solve(system, np.array([truth.plane_distance, normal @ at, system[2] @ middle]))
        line = foot + np.linspace(-0.04, 0.04, 801)[:, None] * system[2]
        local = (line - at) @ seen[:3, :3]
        if self.bend:
            # Two rounds move the line onto the bent surface: the rest of the shift is far below a micrometre.
            for _ in range(3):
                sag = bend_of(self.fine, self.bend, local)
                slope = truth.plane_normal @ normal
                away = normal - slope * truth.plane_normal
                line = foot + np.linspace(-0.04, 0.04, 801)[:, None] * system[2] + sag[:, None] * away / (1 - slope**2)
                local = (line - at) @ seen[:3, :3]
        centre = centre_of(self.fine)[:2]
        on = (np.abs(local[:, :2] - centre) < size / 2).all(axis=1)
        columns = np.full(height, np.nan)
        if np.count_nonzero(on) > 10:
            pixels = _optics(truth.scan_lens, drawing.SCAN_SIZE).project(line[on])
            pixels = pixels[np.argsort(pixels[:, 1])]
            columns = np.interp(np.arange(height), pixels[:, 1], pixels[:, 0], left=np.nan, right=np.nan)
            columns[(columns < 5) | (columns > width - 6)] = np.nan
        columns = columns + self.rng.normal(0.0, STRIPE_PX, height)
        return profile_of(columns, STRIPE_PX)

    def _camera_from(self, rest: Rest, base_from_board: Array, carriage: float) -> Array:
        base_from_camera = rest.true @ self.truth.flange_from_scan
        base_from_camera = base_from_camera @ shifted(carriage * self.truth.rail_direction)
        return np.asarray(inverse(base_from_camera) @ base_from_board, dtype=np.float64)

    def _photo(self, pose: Array, lens: Array, size: tuple[int, int], spec: BoardSpec, bend: float = 0.0) -> BoardView:
        points = spec.points()
        rims = (points[:, None] + spec.dot_radius * circle(RIM)).reshape(-1, 3)
        if bend:
            rims[:, 2] += bend_of(spec, bend, rims)
        pixels = _optics(lens, size).project(rims @ pose[:3, :3].T + pose[:3, 3]).reshape(len(points), RIM, 2)
        centres = ellipse_centres(pixels) + self.rng.normal(0.0, DOTS_PX, (len(points), 2))
        inside = ((pixels > EDGE_PX) & (pixels < np.array(size) - 1 - EDGE_PX)).all(axis=(1, 2))
        ids = np.flatnonzero(inside)
        return BoardView(spec, size, ids, centres[ids], np.full(len(ids), DOTS_PX), dot_radius=spec.dot_radius)

    def collect_scan(self, views: Sequence[CalibrationView] | None = None) -> list[ScanObservation]:
        """What `cell.procedures.calibrate.boards.collect_scan` brings, at the same views."""
        made = []
        for k, view in enumerate(scan_calibration_views(self.config, self.fine) if views is None else views):
            rest = self.move(view.base_from_flange.homogeneous)
            carriage = self.carriage(view.rail_position)
            reported = from_matrix(rest.reported)
            seen, lit = self.scan_view(rest, carriage), self.stripe(rest, carriage)
            made.append(ScanObservation(seen, lit, reported, view.rail_position, f"fine {k + 1}"))
            for way in (-RAIL_MOVE, RAIL_MOVE) if k in RAIL_MOVE_VIEWS else ():
                position = view.rail_position + way
                seen = self.scan_view(rest, self.carriage(position))
                made.append(ScanObservation(seen, None, reported, position, f"fine {k + 1} {way}", same_rest=True))
        return made

    def calibrated(self, arm: str) -> CellCalibration:
        """The calibration by what it observes; the arm has this serial number."""
        observed = self.collect_scan(), self.collect_target(), {"arm": arm}
        return solve_observations(gathered(*observed, self.config)).calibration

    def collect_target(self) -> list[TargetObservation]:
        """What `cell.procedures.calibrate.boards.collect_target` brings, at the same views."""
        made = []
        for k, view in enumerate(target_calibration_views(self.config, self.large)):
            rest = self.move(view.base_from_flange.homogeneous)
            made.append(TargetObservation(self.target_view(rest), from_matrix(rest.reported), f"large {k + 1}"))
        return made


def bend_of(spec: BoardSpec, sagitta: float, local: Array) -> Array:
    """How far (n,) in m a board bent along x stands out of its plane at board coordinates (n, 3)."""
    half = 0.5 * float(np.ptp(spec.points()[:, 0]))
    return np.asarray(sagitta * ((local[:, 0] - centre_of(spec)[0]) / half) ** 2, dtype=np.float64)


def shifted(translation: Array) -> Array:
    """The pose (4, 4) of a pure translation (3,)."""
    made: Array = np.eye(4)
    made[:3, 3] = translation
    return made


def ellipse_centres(rims: Array) -> Array:
    """Centres (n, 2) of the conics through rims (n, m, 2)."""
    middle = rims.mean(axis=1, keepdims=True)
    scale = np.abs(rims - middle).max(axis=(1, 2), keepdims=True)
    x, y = np.moveaxis((rims - middle) / scale, 2, 0)
    design = np.stack([x * x, x * y, y * y, x, y], axis=2)
    normal = design.transpose(0, 2, 1) @ design
    a, b, c, d, e = np.linalg.solve(normal, design.sum(axis=1)[:, :, None])[:, :, 0].T
    off = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=1) / (4 * a * c - b * b)[:, None]
    return np.asarray(middle[:, 0] + scale[:, 0] * off, dtype=np.float64)


def _optics(lens: Array, size: tuple[int, int]) -> CameraOptics:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(v) for v in lens)
    return CameraOptics(size[0], size[1], fx, fy, cx, cy, (k1, k2, p1, p2, k3))

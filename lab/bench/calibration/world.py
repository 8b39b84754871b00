"""A scan head drawn from a seed and what its calibration would see, by code that shares nothing with the estimator.

The simulator's lens, and rays, planes and poses written anew here, so that errors cannot cancel. Everything hangs on
one vector of parameters, which lets `cramer_rao` differentiate the very generator of the observations.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cell.config.cell_config import load_config
from cell.measure.calibration import Priors
from cell.measure.vision.board.view import BoardSpec, centre_of, parse_board
from cell.measure.vision.stripe.profile import StripeProfile
from cell.procedures.arm.photograph import scan_calibration_views
from sim_backends.optics.camera import project_points, undistort_pixels
from sim_backends.world.levels import NOMINAL

Array = NDArray[np.float64]

SHARED = 26
"""Lens (8: fx, fy, cx, cy, k1, k2, p1, p2), light plane n/d (3), rail (3), hand-eye (6), board (6)."""
OWN = 7
"""Of each view: the flange's departure (3 m, 3 rad) from where it is said to be, and the rail's position in m."""
RIM = 24
NEWTON = 5
WIDTH, HEIGHT = 640, 480
STRIPE_WIDTH_PX = 1.5


@dataclass(frozen=True)
class Noise:
    """One standard deviation each: dots and stripe in px, rail in m, arm in m (radial, 1/√3 of it per axis) and rad.
    The defaults are those of docs/explanation/theory.md, section 12."""

    dots: float = 0.05
    stripe: float = 0.07
    rail: float = 2e-5
    arm: float = 5e-5
    arm_angle: float = 1e-4

    @property
    def own(self) -> Array:
        """Deviations (7,) of a view's own parameters."""
        return np.array([self.arm / np.sqrt(3)] * 3 + [self.arm_angle] * 3 + [self.rail])

    @property
    def priors(self) -> Priors:
        """The same for the adjustment."""
        return Priors(self.arm / np.sqrt(3), self.arm_angle, self.rail)

    def times(self, factor: float) -> "Noise":
        """The same noise, all of it `factor` times as large."""
        return Noise(**{name: factor * value for name, value in vars(self).items()})

    def as_dict(self) -> dict[str, float]:
        """For reports."""
        return {
            "dots_px": self.dots, "stripe_px": self.stripe, "rail_mm": 1e3 * self.rail,
            "arm_radial_mm": 1e3 * self.arm, "arm_rotation_mrad": 1e3 * self.arm_angle,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class HeadWorld:
    """The true scan head and the poses (n, 4, 4) base_from_flange and rail positions (n,) in m that it is sent to.

    The light sheet is off its plane by `bow` y²/r, with y in m beside the ray from the laser that is nearest to the
    camera's axis and r along it.
    """

    parameters: Array
    hand: Array
    board: Array
    flanges: Array
    rails: Array
    spec: BoardSpec
    bow: float = 0.0

    def moved(self, step: Array) -> "HeadWorld":
        """Another head, away by a step (26,) of the shared parameters."""
        return replace(
            self, parameters=self.parameters + step[:14], hand=turned(self.hand, step[14:20]),
            board=turned(self.board, step[20:26]),
        )  # fmt: skip

    @property
    def lens(self) -> Array:
        """(9,) fx, fy, cx, cy, k1, k2, p1, p2, k3."""
        return np.append(self.parameters[:8], 0.0)

    @property
    def plane(self) -> Array:
        """(3,) m with m·P = 1 on the light plane, camera frame, 1/m."""
        return np.asarray(self.parameters[8:11])

    @property
    def rail(self) -> Array:
        """(3,) metres that the camera moves, in its axes, per metre of carriage."""
        return np.asarray(self.parameters[11:14])

    def camera_from_board(self, view: int, own: Array) -> Array:
        """(4, 4) of the board as a view sees it whose own parameters depart by `own` (7,)."""
        flange_from_camera = self.hand.copy()
        flange_from_camera[:3, 3] += self.hand[:3, :3] @ self.rail * (self.rails[view] + own[6])
        base_from_camera = turned(self.flanges[view], own[:6]) @ flange_from_camera
        return np.asarray(np.linalg.solve(base_from_camera, self.board))

    def dots(self, view: int, own: Array) -> Array:
        """Pixels (n, 2) of the dots: centroids of their distorted images, from polygons on their rims."""
        pose = self.camera_from_board(view, own)
        rim = self.spec.dot_radius * circle(RIM)
        points = (self.spec.points()[:, None] + rim).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
        return centroids(project_points(np.ascontiguousarray(points), self.lens).reshape(-1, RIM, 2))

    def stripe(self, view: int, own: Array, rows: Array) -> tuple[Array, Array]:
        """Columns (n,) at which the stripe on the board crosses image rows (n,), and where on the board (n, 2) in m."""
        pose = self.camera_from_board(view, own)
        normal = pose[:3, 2]
        along = np.cross(self.plane, normal)
        along /= np.linalg.norm(along)
        if along[1] < 0:
            along = -along
        system = np.array([self.plane, normal, along])
        middle = pose[:3, :3] @ centre_of(self.spec) + pose[:3, 3]
        start = np.linalg.solve(system, np.array([1.0, normal @ pose[:3, 3], along @ middle]))
        place = np.zeros(len(rows))
        pixels = np.zeros((len(rows), 2))
        for _ in range(NEWTON):
            pixels = project_points(self._on_sheet(start + place[:, None] * along, normal), self.lens)
            further = project_points(self._on_sheet(start + (place + 1e-6)[:, None] * along, normal), self.lens)
            slope = (further[:, 1] - pixels[:, 1]) / 1e-6
            place = place + np.clip((rows - pixels[:, 1]) / slope, -0.02, 0.02)
        points = self._on_sheet(start + place[:, None] * along, normal)
        return pixels[:, 0], (points - pose[:3, 3]) @ pose[:3, :2]

    def _on_sheet(self, points: Array, board: Array) -> Array:
        """Points (n, 3) of the light plane, moved on the board of unit normal `board` to where the bowed sheet is."""
        length = np.linalg.norm(self.plane)
        plane = self.plane / length
        laser = np.array([-0.035, 0.0, 0.0])
        laser = laser - (plane @ laser - 1.0 / length) * plane
        middle = np.array([0.0, 0.0, 1.0]) - plane[2] * plane
        middle /= np.linalg.norm(middle)
        way = points - laser
        sag = self.bow * (way @ np.cross(plane, middle)) ** 2 / (way @ middle)
        side = plane - (plane @ board) * board
        # The plane's normal points away from the camera; the sag is told along the one that points to the right.
        return np.asarray(points + np.sign(plane[0]) * sag[:, None] * side / (plane @ side))

    def measured(self, pixels: Array, rails: Array) -> Array:
        """Points (n, 3) in the camera's frame at rail position 0 of stripe pixels (n, 2) at rail positions (n,); m."""
        xy = undistort_pixels(np.ascontiguousarray(pixels), self.lens)
        rays = np.column_stack([xy, np.ones(len(xy))])
        return np.asarray(rays / (rays @ self.plane)[:, None] + rails[:, None] * self.rail)


def profile_of(columns: Array, sigma: float, width: float = STRIPE_WIDTH_PX) -> StripeProfile:
    """A profile of stripe centres (h,), one of each row, with one standard deviation and one width, px."""
    same, none = np.ones(len(columns)), np.zeros(len(columns), dtype=np.bool_)
    return StripeProfile("rows", columns, sigma * same, 150 * same, width * same, none, none)


def circle(count: int) -> Array:
    """Points (n, 3) around a unit circle in the plane z = 0."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])


def centroids(rings: Array) -> Array:
    """Centroids (n, 2) of polygons (n, m, 2)."""
    middle = rings.mean(axis=1, keepdims=True)
    here, after = rings - middle, np.roll(rings, -1, axis=1) - middle
    twice = here[..., 0] * after[..., 1] - here[..., 1] * after[..., 0]
    moment = ((here + after) * twice[..., None]).sum(axis=1)
    return np.asarray(middle[:, 0] + moment / (3 * twice.sum(axis=1))[:, None])


def turned(pose: Array, step: Array) -> Array:
    """A pose (4, 4) moved by (3 m, 3 rad) in the outer frame's axes."""
    made = pose.copy()
    made[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    made[:3, 3] += step[:3]
    return made


def draw_head(rng: np.random.Generator) -> HeadWorld:
    """A head that departs from the drawing as the simulator's level `nominal` says, sent to the cell's own views."""
    config = load_config(None)
    spec = parse_board(config.calibration.fine.board)
    views = scan_calibration_views(config, spec)
    focal = config.scan_camera.focal_length / config.scan_camera.pixel * (1 + NOMINAL.focal_length * rng.normal())
    centre = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2]) + NOMINAL.principal_point * rng.normal(size=2)
    k1 = NOMINAL.distortion_k1 * rng.normal()
    normal = np.array([1.0, 0.0, -1.0 / config.laser.tan_theta]) + NOMINAL.light_plane_tilt * rng.normal(size=3)
    through = np.array([-config.laser.baseline, 0.0, 0.0]) + NOMINAL.light_plane_offset * rng.normal(size=3)
    rail = np.array([1.0, 0.0, 0.0]) + np.array([NOMINAL.rail_lead] + [NOMINAL.rail_direction] * 2) * rng.normal(size=3)
    mount = np.repeat([NOMINAL.hand_eye_translation, NOMINAL.hand_eye_rotation], 3)
    deck = np.repeat([NOMINAL.deck_board_translation, NOMINAL.deck_board_rotation], 3)
    return HeadWorld(
        np.concatenate([[focal, focal, *centre, k1, 0, 0, 0], normal / (normal @ through), rail]),
        turned(config.scan_camera.flange_from_camera.se3().homogeneous, mount * rng.normal(size=6)),
        turned(config.calibration.fine.base_from_board.se3().homogeneous, deck * rng.normal(size=6)),
        np.array([view.base_from_flange.homogeneous for view in views]),
        np.array([view.rail_position for view in views]),
        spec,
    )


def seen_dots(pixels: Array) -> NDArray[np.intp]:
    """Which dots (n, 2) lie in the picture with all of their rim."""
    return np.flatnonzero(((pixels > 14) & (pixels < (WIDTH - 15, HEIGHT - 15))).all(axis=1))


def seen_rows(world: HeadWorld, view: int, own: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Columns (height,) of the stripe, NaN beside the board or the picture, and which rows are clear of the print."""
    columns, at = world.stripe(view, own, np.arange(HEIGHT, dtype=np.float64))
    points = world.spec.points()[:, :2]
    low, high = points.min(axis=0) - world.spec.pitch, points.max(axis=0) + world.spec.pitch
    there = ((at > low) & (at < high)).all(axis=1) & (columns > 5) & (columns < WIDTH - 6)
    columns[~there] = np.nan
    nearest = np.linalg.norm(at[:, None] - points, axis=2).min(axis=1)
    half = 2.5 * STRIPE_WIDTH_PX * 0.13 / world.lens[0]
    return columns, there & (nearest > world.spec.dot_radius + half)

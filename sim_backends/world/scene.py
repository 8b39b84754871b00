"""The true world of one seed and level: every deviation drawn once, before anything moves.

Each quantity has its own random stream, named after it, so that a new quantity leaves all others as they were.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_backends.world.drawing import (
    RAIL_DIRECTION,
    STOCK,
    CameraDrawing,
    CellDrawing,
    Drawing,
    StationDrawing,
    inverse,
    pose,
)
from sim_backends.world.levels import CUT, WARMING_K, Deviations, Effects, deviations, effects_of, number_of

Pose = NDArray[np.float64]
Vector = NDArray[np.float64]


def stream(seed: int, name: str) -> np.random.Generator:
    """The random stream of the quantity `name` in the world of `seed`, independent of every other one."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def rotation(vector: Vector) -> Pose:
    """The rotation (3, 3) about `vector` (3,) by its length, rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    made: Pose = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return made


@dataclass(frozen=True)
class Lens:
    """A pinhole with distortion: focal lengths and principal point, px; OpenCV's k1, k2, p1, p2, k3."""

    fx: float
    fy: float
    cx: float
    cy: float
    dist: tuple[float, float, float, float, float]


@dataclass(frozen=True)
class CameraClock:
    """A camera's own clock: relative drift, reading at world time 0, lag of time stamps behind exposures; s."""

    drift: float
    epoch: float
    latency: float


@dataclass(frozen=True)
class Workshop:
    """What was drawn of the workshop's effects; all 0 where they are off.

    `harmonics` (6, 4): each joint's sine and cosine of one turn of its motor, then of two, rad. `sheet_bow`: how
    far the light sheet is off its plane at the place that `Effects` names, m. Once all is warm: `pointing`, turn of
    the light plane about the stripe's direction, rad; `shift` (2, 2) of the scan and the target camera's principal
    points, px; `zoom`, relative. `rocking`: roll and pitch (2,), rad, at `rocking_hz` with `rocking_phase` (2,),
    rad; `wind` (2,), rad, what gusts add to it. `ground` (4,): roll and pitch of the ground's waves, and where they
    begin, rad. `heat` (3,): how far the scan camera's mount moves as it warms, m. `sun_start` in m, `klx` in the open.
    `oil` (3,): the puddle's place, x and y from -1 to 1 across the surface, and its radius, m.
    """

    harmonics: Vector
    sheet_bow: float
    pointing: float
    shift: Vector
    zoom: float
    rocking: Vector
    rocking_hz: float
    rocking_phase: Vector
    wind: Vector
    ground: Vector
    heat: Vector
    sun_start: float
    klx: float
    oil: Vector


@dataclass(frozen=True)
class Scene:
    """Where everything really is. Poses are (4, 4), metres, named `a_from_b`; frames as in `drawing`. The station
    carries table and surface: where `world_from_surface` is off, the table is off with it."""

    seed: int
    level: str
    drawing: Drawing
    deviations: Deviations
    effects: Effects
    world_from_vehicle_start: Pose
    vehicle_from_base: Pose
    world_from_place: Pose
    world_from_table: Pose
    world_from_surface: Pose
    world_from_board: Pose
    base_from_fine_board: Pose
    base_from_deck_board: Pose
    flange_from_scan_camera: Pose
    flange_from_target_camera: Pose
    flange_from_part: Pose
    surface_from_part: Pose
    """Of a part that lies on the surface at first."""
    scan_lens: Lens
    target_lens: Lens
    light_plane_normal: Vector
    light_plane_distance: float
    laser_origin: Vector
    rail_direction: Vector
    rail_lead_error: float
    rail_periodic_amplitude: float
    rail_periodic_phase: float
    rail_backlash: float
    dh_factory: Pose
    dh_error: Pose
    odometry_scale: float
    odometry_yaw: float
    suspension: Vector
    light_level: float
    light_gradient: Vector
    scan_clock: CameraClock
    target_clock: CameraClock
    workshop: Workshop

    @property
    def serial(self) -> str:
        """Seven digits or more that tell this world's hardware from that of every other seed and level."""
        return f"{self.seed:06d}{number_of(self.level)}"


class _Draws:
    """Cut Gaussian draws, one stream a name."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def vector(self, name: str, sigma: float, size: int = 3) -> Vector:
        drawn = stream(self.seed, name).standard_normal(size)
        return sigma * np.clip(drawn, -CUT, CUT)

    def scalar(self, name: str, sigma: float) -> float:
        return float(self.vector(name, sigma, 1)[0])

    def even(self, name: str, most: float) -> float:
        """Anywhere from 0 to `most`."""
        return most * float(stream(self.seed, name).uniform())

    def moved(self, name: str, at: Pose, translation: float, turn: float, about: Sequence[float] = (0, 0, 0)) -> Pose:
        """`at`, moved and turned about the point `about` of its own frame."""
        made = np.eye(4)
        made[:3, :3] = rotation(self.vector(name + ".rotation", turn))
        made[:3, 3] = np.array(about) - made[:3, :3] @ about + self.vector(name + ".translation", translation)
        return at @ made


DOCKED = 0.1
"""How much of a vehicle's deviation from its start a station has that is pushed against a fixed frame's stops."""


def draw(seed: int, level: str, drawing: Drawing = STOCK, parts: int = 0) -> Scene:
    """Draw the world of `seed` at `level` around `drawing`; the claw holds its next part after so many `parts`. Raises
    ValueError for an unknown level or a negative seed."""
    sigma, effects = deviations(level), effects_of(level)
    if drawing.cell.fixed:
        # No tyres, no springs, no way over the ground.
        effects = replace(effects, rocking=0.0, wind=0.0, ground=0.0)
    if seed < 0:
        raise ValueError(f"seed {seed} must be 0 or greater")
    d = _Draws(seed)
    cell, station = drawing.cell, drawing.station
    normal, distance, origin = _light_plane(d, sigma, cell)
    world_from_place = _stands(d, sigma, station)
    name, lies = f"station.{station.stop}".rstrip("."), world_from_place @ station.place_from_surface
    surface = d.moved(name, lies, sigma.station_translation, sigma.station_rotation)
    deck = (sigma.deck_board_translation, sigma.deck_board_rotation)
    grasp = "grasp" if parts == 0 else f"grasp.{parts}"
    return Scene(
        seed=seed, level=level, drawing=drawing, deviations=sigma, effects=effects,
        world_from_vehicle_start=_start(d, sigma, drawing, world_from_place), vehicle_from_base=cell.vehicle_from_base,
        world_from_place=world_from_place, world_from_table=surface @ inverse(station.place_from_surface),
        world_from_surface=surface, world_from_board=world_from_place @ station.place_from_board,
        base_from_fine_board=d.moved("fine_board", cell.base_from_fine_board, *deck),
        base_from_deck_board=d.moved("deck_board", cell.base_from_deck_board, *deck),
        flange_from_scan_camera=d.moved(
            "hand_eye", cell.scan.mounting, sigma.hand_eye_translation, sigma.hand_eye_rotation
        ),
        flange_from_target_camera=d.moved(
            "target_mount", cell.target.mounting, sigma.target_mount_translation, sigma.target_mount_rotation
        ),
        flange_from_part=d.moved(grasp, station.flange_from_part, sigma.grasp_translation, sigma.grasp_rotation),
        surface_from_part=_lies(d, grasp.replace("grasp", "lies"), station),
        scan_lens=_lens(d, "scan_lens", sigma, cell.scan), target_lens=_lens(d, "target_lens", sigma, cell.target),
        light_plane_normal=normal, light_plane_distance=distance, laser_origin=origin,
        rail_direction=rotation(d.vector("rail_direction", sigma.rail_direction)) @ RAIL_DIRECTION,
        rail_lead_error=d.scalar("rail_lead", sigma.rail_lead),
        rail_periodic_amplitude=abs(d.scalar("rail_periodic", sigma.rail_periodic)),
        rail_periodic_phase=float(stream(seed, "rail_phase").uniform(0.0, 2.0 * np.pi)),
        rail_backlash=abs(d.scalar("rail_backlash", sigma.rail_backlash)), dh_factory=_dh_factory(d, sigma),
        dh_error=_dh_error(d, sigma), odometry_scale=d.scalar("odometry_scale", sigma.odometry_scale),
        odometry_yaw=d.scalar("odometry_yaw", sigma.odometry_yaw),
        suspension=(not cell.fixed) * np.abs(d.vector("suspension", sigma.suspension, 2)),
        light_level=1.0 + d.scalar("light_level", sigma.ambient),
        light_gradient=d.vector("light_gradient", sigma.ambient, 2), scan_clock=_clock(d, "scan_clock", sigma, effects),
        target_clock=_clock(d, "target_clock", sigma, effects), workshop=_workshop(d, effects),
    )  # fmt: skip


LIES = (0.5e-3, 4e-3)
"""How a part lies beside its place, along the surface and about its normal, m and rad, one standard deviation."""


def _lies(d: _Draws, name: str, station: StationDrawing) -> Pose:
    """Where a part lies on the surface at first, S from part, before its weight settles it."""
    aside = np.eye(4)
    aside[:2, 3] = d.vector(f"{name}.translation", LIES[0], 2)
    aside[:3, :3] = rotation(np.array([0.0, 0.0, d.scalar(f"{name}.rotation", LIES[1])]))
    made: Pose = station.surface_from_part @ aside
    return made


def _stands(d: _Draws, sigma: Deviations, station: StationDrawing) -> Pose:
    """Where the place frame of a station lies, W from P. One that is not the first is off its drawn place as a vehicle
    is off its start."""
    if station.place_from_stop is None:
        return pose((0.0, 0.0, station.height), (1, 0, 0), (0, 0, 1))
    off, name = np.eye(4), f"stop.{station.stop}"
    off[:2, 3] = d.vector(f"{name}.translation", sigma.start_translation, 2)
    off[:3, :3] = rotation(np.array([0.0, 0.0, d.scalar(f"{name}.rotation", sigma.start_rotation)]))
    made: Pose = station.place_from_stop @ off
    made[2, 3] = station.height
    return made


def _start(d: _Draws, sigma: Deviations, drawing: Drawing, world_from_place: Pose) -> Pose:
    """Where the vehicle starts, W from V."""
    start = world_from_place @ drawing.station.place_from_start
    # A station is brought to a fixed frame against stops.
    loose = DOCKED if drawing.cell.fixed else 1.0
    start[:2, 3] += loose * d.vector("start.translation", sigma.start_translation, 2)
    turned = loose * d.scalar("start.rotation", sigma.start_rotation)
    start[:3, :3] = rotation(np.array([0.0, 0.0, turned])) @ start[:3, :3]
    made: Pose = start
    return made


def _light_plane(d: _Draws, sigma: Deviations, cell: CellDrawing) -> tuple[Vector, float, Vector]:
    """Unit normal, distance and exit point, in C: as drawn X = −l + Z cot θ (docs/explanation/theory.md, section 2)."""
    plain = np.array([1.0, 0.0, -1.0 / cell.tan_theta])
    normal = rotation(d.vector("light_plane.tilt", sigma.light_plane_tilt)) @ (plain / np.linalg.norm(plain))
    origin = np.array([-cell.baseline, 0.0, 0.0]) + d.vector("light_plane.offset", sigma.light_plane_offset)
    return normal, float(normal @ origin), origin


def _lens(d: _Draws, name: str, sigma: Deviations, camera: CameraDrawing) -> Lens:
    focal = camera.focal_length / camera.pixel * (1.0 + d.scalar(name + ".focal", sigma.focal_length))
    # The two focal lengths differ by what pixels that are not quite square give.
    aspect = 1.0 + 0.04 * d.scalar(name + ".aspect", sigma.focal_length)
    shift = d.vector(name + ".principal", sigma.principal_point, 2)
    k1, k2 = d.vector(name + ".distortion", sigma.distortion_k1, 2)
    p1, p2 = d.vector(name + ".tangential", 0.02 * sigma.distortion_k1, 2)
    cx, cy = (camera.size[0] - 1) / 2.0 + float(shift[0]), (camera.size[1] - 1) / 2.0 + float(shift[1])
    return Lens(focal, focal * aspect, cx, cy, (float(k1), 0.5 * float(k2), float(p1), float(p2), 0.0))


def _dh_factory(d: _Draws, sigma: Deviations) -> Pose:
    """What the factory measured (6, 4), the controller's table less the maker's: a and d in m, alpha and offset in rad.

    The last joint's a and alpha are those of the maker, as in the tables that were published. Axes 2 to 4 are almost
    parallel: their d also hold a slide along them that cancels.
    """
    made = np.zeros((6, 4))
    made[:5, 0] = d.vector("factory.a", sigma.arm_factory_length, 5)
    made[:, 1] = d.vector("factory.d", sigma.arm_factory_length, 6)
    made[:5, 2] = d.vector("factory.alpha", sigma.arm_factory_angle, 5)
    made[:, 3] = d.vector("factory.offset", sigma.arm_factory_angle, 6)
    first, second = d.vector("factory.slide", sigma.arm_factory_slide, 2)
    made[1:4, 1] += [first, second, -first - second]
    return made


def _dh_error(d: _Draws, sigma: Deviations) -> Pose:
    """What the factory has left (6, 4): errors of a, d in m, alpha (exact) and joint offset in rad, a row per joint."""
    error = np.zeros((6, 4))
    error[:, 0] = d.vector("dh.a", sigma.arm_dh_length, 6)
    error[:, 1] = d.vector("dh.d", sigma.arm_dh_length, 6)
    error[:, 3] = d.vector("dh.offset", sigma.arm_dh_angle, 6)
    return error


def _clock(d: _Draws, name: str, sigma: Deviations, effects: Effects) -> CameraClock:
    drift = d.scalar(name + ".drift", sigma.camera_clock_drift)
    latency = abs(d.scalar(name + ".latency", sigma.exposure_latency))
    epoch = 1000.0 + abs(d.scalar(name + ".epoch", 1000.0))
    return CameraClock(drift, epoch, latency + d.even(name + ".late", effects.late_stamps))


def _workshop(d: _Draws, effects: Effects) -> Workshop:
    direction = d.even("rocking.direction", 2.0 * np.pi)
    warm = effects.camera_warm_up * WARMING_K
    return Workshop(
        # Four independent terms a joint: half the RMS each, √2 of that as amplitude.
        harmonics=d.vector("harmonics", effects.joint_harmonics / np.sqrt(2.0), 24).reshape(6, 4),
        sheet_bow=d.scalar("sheet_bow", effects.sheet_bow),
        pointing=d.scalar("pointing", effects.laser_pointing) * WARMING_K,
        shift=d.vector("warm_shift", warm, 4).reshape(2, 2),
        zoom=1e-5 * WARMING_K * bool(warm),
        rocking=effects.rocking * np.array([np.cos(direction), np.sin(direction)]),
        wind=effects.wind * np.array([np.cos(direction), np.sin(direction)]),
        ground=np.append(d.vector("ground", effects.ground, 2), d.vector("ground.phase", np.pi / CUT, 2)),
        heat=d.vector("heat", effects.heat),
        rocking_hz=4.0 * (1.0 + d.scalar("rocking.frequency", 0.05)),
        rocking_phase=d.vector("rocking.phase", 1.0, 2) * np.pi,
        sun_start=d.scalar("sun", 0.05),
        klx=effects.sun * (0.2 + d.even("klx", 0.8)),
        oil=bool(effects.oil) * stream(d.seed, "oil").uniform((-0.6, -0.6, 6e-3), (0.6, 0.6, 10e-3)),
    )

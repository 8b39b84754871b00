"""What the two cameras see: which objects are in view, where, and the picture that the optics make of them.

Poses come in, pictures go out; time and motion are the world's business.
"""

import threading
import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.daylight import ROOMS_PER_KLX, laser_passed, share_passed
from sim_backends.optics.render import render
from sim_backends.optics.scene import (
    Board,
    BoardInstance,
    Grain,
    LaserOptics,
    Light,
    MeshInstance,
    PlaneInstance,
    Puddle,
    SceneObject,
    Sun,
)
from sim_backends.world import drawing
from sim_backends.world.bodies.station import Station
from sim_backends.world.drawing import CameraDrawing, inverse
from sim_backends.world.scene import Lens, Scene, rotation, stream

Pose = NDArray[np.float64]
Picture = NDArray[np.uint8]

SCAN_TRANSMISSION = 0.4
"""Share of the ambient light that the scan camera lets through where no filter is described; the laser passes."""
TABLE_ALBEDO = 0.45
WITNESS_ALBEDO = 0.5
SURFACE_ALBEDO = 0.6
BOW_AT = (0.130, 0.018)
"""Where the sheet's bow is told: from the laser, and beside the fan's middle, m."""
SPECKLE_M = 10e-6
"""The speckle stays the same as long as the camera stands still, to so much."""
SUN_SPEED = 0.2e-3
"""m/s: a quarter of a degree a minute, from a window 3 m away."""
OUTSIDE_M = 1.5
"""So far from the place the open begins: cells are calibrated under a roof."""
SKY = 0.15
"""Share of a clear day's light that comes from the sky, and into the shadow."""
SWAY_M, SWAY_S = 0.03, 8.0
"""How far, and in what time, the shadow of what stands in the wind goes to and fro along the table's x axis."""
_FAR = {"scan": (0.5, 3.0), "target": (3.0, 3.0)}
"""Beyond this distance, m, and so many times its focus, a camera has nothing to see that matters."""


class Cameras:
    """The scan camera with its laser and the target camera of one scene; safe between threads."""

    def __init__(self, scene: Scene, station: Station) -> None:
        cell = scene.drawing.cell
        gx, gy = (float(v) for v in scene.light_gradient)
        self._light = Light(level=scene.light_level, gradient=(gx, gy))
        self._witness_pose = cell.witness
        self._deck = (Board.parse(cell.deck_board), Board.parse(cell.fine_board))
        self.show(scene, station)
        self._rng = {name: stream(scene.seed, f"{name}_camera.noise") for name in self._cold}
        self._busy = {name: threading.Lock() for name in self._cold}

    def show(self, scene: Scene, station: Station, others: Sequence[tuple[Scene, Station]] = ()) -> None:
        """From now on the cameras see this station, in this scene, of the same drawing and clocks; and of `others` the
        surfaces that lie elsewhere, and the tables and boards of other stops."""
        effects, cell = scene.effects, scene.drawing.cell
        self._lens = {"scan": scene.scan_lens, "target": scene.target_lens}
        self._cold = {
            "scan": _optics(scene, scene.scan_lens, cell.scan, SCAN_TRANSMISSION),
            "target": _optics(scene, scene.target_lens, cell.target, 1.0),
        }
        x, y, z = (float(v) for v in scene.laser_origin)
        nx, ny, nz = (float(v) for v in scene.light_plane_normal)
        self._laser = LaserOptics(
            origin=(x, y, z), normal=(nx, ny, nz), distance=scene.light_plane_distance,
            brightness=LaserOptics.brightness * (1.0 if cell.scan.filter is None else laser_passed(cell.scan.filter)),
            speckle_contrast=scene.deviations.speckle_contrast,
            bow=scene.workshop.sheet_bow * BOW_AT[0] / BOW_AT[1] ** 2, end=effects.sheet_ends,
            shadows=((-0.06, 0.004, 0.7), (0.035, 0.002, 0.9)) if effects.dust else (),
        )  # fmt: skip
        x, y, radius = (float(v) for v in scene.workshop.oil)
        ground, oil = station.ground, None
        if effects.oil:
            at = (ground.centre[0] + x * ground.half_x, ground.centre[1] + y * ground.half_y)
            oil = Puddle(at, radius, effects.oil)
        self._grain = Grain(effects.texture, effects.dust, effects.gloss, oil)
        self._shown = scene, station
        stops = {of.drawing.station.stop: of for of in (*(of for of, _ in others), scene)}
        self._stops = [(of, Board.parse(of.drawing.station.board)) for of in stops.values()]
        there = [(of.world_from_surface, other) for of, other in others]
        self._others = [each for each in there if not np.array_equal(each[0], scene.world_from_surface)]

    def picture(
        self, camera: str, world_from_camera: Pose, world_from_base: Pose, laser: bool, exposure: float,
        warm: float = 0.0, t: float = 0.0, camera_from_flange: Pose | None = None,
        parts: Sequence[tuple[Station, Pose]] = (),
    ) -> Picture:  # fmt: skip
        """The picture (height, width) of `camera`, "scan" or "target", exposed for `exposure` s at these poses.

        `warm` is how far, of 0 to 1, laser and cameras have warmed up; `t` the world time, s, by which the sun moves.
        With `camera_from_flange` the plate on the claw is shown where it comes into view. `parts` are shown at their
        world_from_part where their stations have their shape.
        """
        optics = self._warmed(camera, warm)
        camera_from_world = inverse(world_from_camera)
        objects = self._objects(camera, camera_from_world, world_from_base)
        if camera == "scan" and camera_from_flange is not None:
            objects += self._witness(camera_from_flange)
        if camera == "scan":
            objects += [seen for station, at in parts for seen in self._part(station, camera_from_world @ at)]
        with self._busy[camera]:
            lit = self.laser(warm) if laser and camera == "scan" else None
            still = np.rint(camera_from_world[:3] / SPECKLE_M).astype(np.int64)
            speckle = np.random.default_rng([self._shown[0].seed, zlib.crc32(still.tobytes())])
            light = self._lit(camera_from_world, t)
            return render(optics, objects, lit, exposure, self._rng[camera], light=light, speckle=speckle)

    def _witness(self, camera_from_flange: Pose) -> list[SceneObject]:
        """The plate on the claw, if the camera sees any of it."""
        if self._witness_pose is None:
            return []
        pose = camera_from_flange @ self._witness_pose
        corners, optics = _witness_corners(pose), self._cold["scan"]
        left = (-0.55 * optics.width / optics.fx) * corners[:, 2]
        return [PlaneInstance(pose, drawing.WITNESS_SIZE, WITNESS_ALBEDO)] if (corners[:, 0] > left).any() else []

    def _part(self, station: Station, pose: Pose) -> list[SceneObject]:
        mesh, optics = station.part_seen, self._cold["scan"]
        if mesh is None:
            return []
        low, high = mesh.low[0], mesh.high[0]
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        seen = in_picture(optics, corners @ pose[:3, :3].T + pose[:3, 3])
        return [MeshInstance(pose, mesh, SURFACE_ALBEDO)] if seen else []

    def lens(self, camera: str, warm: float) -> Lens:
        """The lens with the shift and zoom of what is `warm`, 0 to 1."""
        cold, drawn = self._lens[camera], self._shown[0].workshop
        zoom, (du, dv) = 1.0 + warm * drawn.zoom, warm * drawn.shift[int(camera == "target")]
        return replace(cold, fx=cold.fx * zoom, fy=cold.fy * zoom, cx=cold.cx + float(du), cy=cold.cy + float(dv))

    def laser(self, warm: float) -> LaserOptics:
        """The laser with its plane turned about its exit point and the stripe's direction (the camera's y axis)."""
        angle = warm * self._shown[0].workshop.pointing
        if angle == 0.0:
            return self._laser
        turn = rotation(np.array([0.0, angle, 0.0]))
        nx, ny, nz = (float(v) for v in turn @ self._laser.normal)
        return replace(self._laser, normal=(nx, ny, nz), distance=float(np.dot((nx, ny, nz), self._laser.origin)))

    def _warmed(self, camera: str, warm: float) -> CameraOptics:
        if not self._shown[0].effects.camera_warm_up:
            return self._cold[camera]
        # In steps of a hundredth, since every lens has a table of its pixels' rays.
        lens = self.lens(camera, round(warm, 2))
        return replace(self._cold[camera], fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy)

    def _lit(self, camera_from_world: Pose, t: float) -> Light:
        """The light with the sun's strip where it is at `t`: a hand's width, slowly along the table's x axis. In the
        open the sky lights all, and the sun all beyond the edge of a shadow."""
        scene, suns = self._shown[0], []
        ground = camera_from_world @ scene.world_from_place
        if strength := scene.effects.sunlight:
            low = scene.workshop.sun_start + SUN_SPEED * t - 0.1
            suns.append(Sun(ground, low, low + 0.12, strength))
        if rooms := ROOMS_PER_KLX * scene.workshop.klx:
            edge = scene.workshop.sun_start + SWAY_M * float(np.sin(2.0 * np.pi * t / SWAY_S))
            suns.append(Sun(ground, -OUTSIDE_M, OUTSIDE_M, SKY * rooms))
            suns.append(Sun(ground, edge, OUTSIDE_M, (1.0 - SKY) * rooms / (1.0 + SKY * rooms)))
        return replace(self._light, suns=tuple(suns)) if suns else self._light

    def _objects(self, camera: str, camera_from_world: Pose, world_from_base: Pose) -> list[SceneObject]:
        scene, station = self._shown
        camera_from_base = camera_from_world @ world_from_base
        table = (2 * drawing.TABLE_HALF, 2 * drawing.TABLE_HALF)
        tables = [camera_from_world @ of.world_from_table for of, _ in self._stops]
        placed: list[tuple[SceneObject, Pose, float]] = [
            (PlaneInstance(at, table, TABLE_ALBEDO), at, drawing.TABLE_HALF * 1.5) for at in tables
        ]
        boards = [
            *((camera_from_world @ of.world_from_board, there) for of, there in self._stops),
            (camera_from_base @ scene.base_from_deck_board, self._deck[0]),
            (camera_from_base @ scene.base_from_fine_board, self._deck[1]),
        ]
        for pose, board in boards:
            x0, x1, y0, y1 = board.bounds
            radius = float(np.hypot(max(-x0, x1), max(-y0, y1)))
            placed.append((BoardInstance(pose, board), pose, radius))
        if camera == "scan":
            for world_from_surface, one in ((scene.world_from_surface, station), *self._others):
                at = camera_from_world @ world_from_surface
                placed.append((MeshInstance(at, one.seen, SURFACE_ALBEDO, self._grain), at, one.radius))
        optics = self._cold[camera]
        far = max(_FAR[camera][0], _FAR[camera][1] * optics.focus_distance)
        return [item for item, pose, radius in placed if in_view(optics, pose[:3, 3], radius, far)]


def _witness_corners(pose: Pose) -> Pose:
    half = np.array(drawing.WITNESS_SIZE) / 2.0
    corners = np.array([[x, y, 0.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    return corners @ pose[:3, :3].T + pose[:3, 3]


def in_view(optics: CameraOptics, centre: NDArray[np.float64], radius: float, far: float) -> bool:
    """Whether any of a ball about `centre` (3,), camera frame, m, may be in the picture nearer than `far`."""
    x, y, z = (float(v) for v in centre)
    if z < -radius or float(np.linalg.norm(centre)) > far + radius:
        return False
    half = 1.2 * np.hypot(optics.width / optics.fx, optics.height / optics.fy) / 2
    # Distance of the ball's centre from the cone that encloses the picture.
    return float(np.hypot(x, y) * np.cos(np.arctan(half)) - z * np.sin(np.arctan(half))) <= radius


def in_picture(optics: CameraOptics, corners: NDArray[np.float64]) -> bool:
    """Whether anything between `corners` (n, 3), camera frame, m, may be in the picture."""
    x, y, z = corners.T
    half_x, half_y = 0.6 * optics.width / optics.fx * z, 0.6 * optics.height / optics.fy * z
    # All beyond one side of the picture, with a fifth of it to spare: nothing between them is in it.
    return not ((x > half_x).all() or (x < -half_x).all() or (y > half_y).all() or (y < -half_y).all() or (z < 0).all())


def _optics(scene: Scene, lens: Lens, drawn: CameraDrawing, transmission: float) -> CameraOptics:
    if drawn.filter is not None:
        transmission = share_passed(drawn.filter)
    return CameraOptics(
        width=drawn.size[0], height=drawn.size[1], fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy,
        distortion=lens.dist, pixel=drawn.pixel, f_number=drawing.F_NUMBER, focal=drawn.focal_length,
        focus_distance=drawn.focus, read_noise_dn=scene.deviations.read_noise, transmission=transmission,
    )  # fmt: skip

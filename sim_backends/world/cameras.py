"""What the two cameras see: which objects are in view, where, and the picture that the optics make of them.

Poses come in, pictures go out; time and motion are the world's business.
"""

from __future__ import annotations

import threading
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.mesh import Mesh
from sim_backends.optics.render import render
from sim_backends.optics.scene import Board, BoardInstance, LaserOptics, Light, MeshInstance, PlaneInstance, SceneObject
from sim_backends.world import nominal
from sim_backends.world.nominal import inverse
from sim_backends.world.scene import Lens, Scene, stream
from sim_backends.world.surfaces import mesh
from sim_backends.world.surfaces import surface as named_surface

Pose = NDArray[np.float64]
Picture = NDArray[np.uint8]

SCAN_TRANSMISSION = 0.4
"""Share of the ambient light that the scan camera's narrow-band filter lets through; the laser passes."""
TABLE_ALBEDO = 0.45
SURFACE_ALBEDO = 0.6
_FAR = {"scan": 0.5, "target": 3.0}
"""Beyond this distance, m, a camera has nothing to see that matters."""


@cache
def _seen_mesh(surface: str) -> Mesh:
    """The surface with its box tree, which takes longer to make than all the rest of a world."""
    made = mesh(surface)
    return Mesh(made.vertices, made.triangles)


class Cameras:
    """The scan camera with its laser and the target camera of one scene; safe between threads."""

    def __init__(self, scene: Scene, surface: str) -> None:
        self._scene = scene
        self._optics = {
            "scan": _optics(scene, scene.scan_lens, nominal.SCAN_SIZE, nominal.SCAN_FOCUS, SCAN_TRANSMISSION),
            "target": _optics(scene, scene.target_lens, nominal.TARGET_SIZE, nominal.TARGET_FOCUS, 1.0),
        }
        x, y, z = (float(v) for v in scene.laser_origin)
        nx, ny, nz = (float(v) for v in scene.light_plane_normal)
        self._laser = LaserOptics(
            origin=(x, y, z),
            normal=(nx, ny, nz),
            distance=scene.light_plane_distance,
            speckle_contrast=scene.deviations.speckle_contrast,
        )
        gx, gy = (float(v) for v in scene.light_gradient)
        self._light = Light(level=scene.light_level, gradient=(gx, gy))
        shape = named_surface(surface)
        self._mesh = _seen_mesh(surface)
        self._mesh_radius = float(np.hypot(shape.half_x, shape.half_y)) + 0.015
        self._large = Board(*nominal.LARGE_BOARD)
        self._fine = Board(*nominal.FINE_BOARD)
        self._rng = {name: stream(scene.seed, f"{name}_camera.noise") for name in self._optics}
        self._busy = {name: threading.Lock() for name in self._optics}

    def picture(
        self, camera: str, world_from_camera: Pose, world_from_base: Pose, laser: bool, exposure: float
    ) -> Picture:
        """The picture (height, width) of `camera`, "scan" or "target", exposed for `exposure` s at these poses."""
        optics = self._optics[camera]
        objects = self._objects(camera, inverse(world_from_camera), world_from_base)
        with self._busy[camera]:
            lit = self._laser if laser and camera == "scan" else None
            return render(optics, objects, lit, exposure, self._rng[camera], self._light)

    def _objects(self, camera: str, camera_from_world: Pose, world_from_base: Pose) -> list[SceneObject]:
        scene = self._scene
        camera_from_base = camera_from_world @ world_from_base
        camera_from_surface = camera_from_world @ scene.world_from_surface
        table = (2 * nominal.TABLE_HALF, 2 * nominal.TABLE_HALF)
        placed: list[tuple[SceneObject, Pose, float]] = [
            (PlaneInstance(camera_from_surface, table, TABLE_ALBEDO), camera_from_surface, nominal.TABLE_HALF * 1.5),
        ]
        boards = [
            (camera_from_world @ scene.world_from_board, self._large),
            (camera_from_base @ scene.base_from_deck_board, self._large),
            (camera_from_base @ scene.base_from_fine_board, self._fine),
        ]
        for pose, board in boards:
            x0, x1, y0, y1 = board.bounds
            radius = float(np.hypot(max(-x0, x1), max(-y0, y1)))
            placed.append((BoardInstance(pose, board), pose, radius))
        if camera == "scan":
            shown = MeshInstance(camera_from_surface, self._mesh, SURFACE_ALBEDO)
            placed.append((shown, camera_from_surface, self._mesh_radius))
        optics = self._optics[camera]
        return [item for item, pose, radius in placed if in_view(optics, pose[:3, 3], radius, _FAR[camera])]


def in_view(optics: CameraOptics, centre: NDArray[np.float64], radius: float, far: float) -> bool:
    """Whether any of a ball about `centre` (3,), camera frame, m, may be in the picture nearer than `far`."""
    x, y, z = (float(v) for v in centre)
    if z < -radius or float(np.linalg.norm(centre)) > far + radius:
        return False
    half = 1.2 * np.hypot(optics.width / optics.fx, optics.height / optics.fy) / 2
    # Distance of the ball's centre from the cone that encloses the picture.
    return float(np.hypot(x, y) * np.cos(np.arctan(half)) - z * np.sin(np.arctan(half))) <= radius


def _optics(scene: Scene, lens: Lens, size: tuple[int, int], focus: float, transmission: float) -> CameraOptics:
    return CameraOptics(
        width=size[0],
        height=size[1],
        fx=lens.fx,
        fy=lens.fy,
        cx=lens.cx,
        cy=lens.cy,
        distortion=lens.dist,
        pixel=nominal.PIXEL,
        f_number=nominal.F_NUMBER,
        focal=nominal.FOCAL_LENGTH,
        focus_distance=focus,
        read_noise_dn=scene.deviations.read_noise,
        transmission=transmission,
    )

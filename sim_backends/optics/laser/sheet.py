"""A light sheet that is not perfect: bowed, fading at its ends, with shadows of dust; and which points it reaches.

The fan's middle is the sheet's direction that is nearest to the camera's axis; y is across it, in the sheet.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.boards import appearance
from sim_backends.optics.camera import step_on_plane
from sim_backends.optics.compiled import compiled
from sim_backends.optics.laser.profile import NARROWEST
from sim_backends.optics.scene import Grain, LaserOptics, MeshInstance, Puddle, SceneObject

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

TOUCH = 5e-6
"""Surfaces nearer than this (m) to the lit point do not shade it: it is the surface itself."""


@lru_cache(maxsize=64)
def laser_frame(laser: LaserOptics) -> tuple[Vector, float, Vector]:
    """Unit normal, distance and origin (moved onto the plane) of the light plane in the camera frame."""
    normal = np.asarray(laser.normal, dtype=np.float64)
    length = float(np.linalg.norm(normal))
    if not 0.5 < length < 2.0:
        raise ValueError(f"light plane normal {laser.normal}: needs about unit length")
    normal, distance = normal / length, laser.distance / length
    origin = np.asarray(laser.origin, dtype=np.float64)
    return normal, distance, origin - (origin @ normal - distance) * normal


def lit(
    points: Vector, normals: Vector, instance: SceneObject, scene: Sequence[SceneObject], laser: LaserOptics
) -> Mask:
    """Which `points` (n, 3) with surface `normals` (n, 3) of `instance` are lit and seen past every object of `scene`.
    A surface is lit and seen when laser and camera are on the same side of it."""
    normal, _, origin = laser_frame(laser)
    axis = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    points = np.ascontiguousarray(points)
    seen = facing(points, np.ascontiguousarray(normals), origin, axis / np.linalg.norm(axis), np.cos(laser.fan))
    for other in scene:
        if isinstance(other, MeshInstance):
            pose = np.asarray(other.camera_from_mesh, dtype=np.float64)
            # A plane that a mesh touches is covered by it; a mesh must not shade itself.
            start = TOUCH if isinstance(instance, MeshInstance) else -2 * TOUCH
            local = (points - pose[:3, 3]) @ pose[:3, :3]
            for eye in (np.zeros(3), origin):
                other.mesh.hide(local, (eye - pose[:3, 3]) @ pose[:3, :3], start, seen)
        elif other is not instance:
            pose, pattern = appearance(other)
            bounds = np.ascontiguousarray(pattern[4:8])
            for eye in (np.zeros(3), origin):
                hide_behind_rectangle(points, eye, np.ascontiguousarray(pose), bounds=bounds, start=TOUCH, seen=seen)
    return seen


@compiled
def facing(points: Vector, normals: Vector, origin: Vector, axis: Vector, cos_fan: float) -> Mask:
    """Points in the laser's fan about `axis` whose surface has laser and camera on the same side."""
    seen = np.zeros(points.shape[0], dtype=np.bool_)
    for i in range(points.shape[0]):
        camera, laser, along, span = 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            ray = points[i, k] - origin[k]
            camera += normals[i, k] * points[i, k]
            laser += normals[i, k] * ray
            along += axis[k] * ray
            span += ray * ray
        seen[i] = camera * laser > 0.0 and along > cos_fan * np.sqrt(span)
    return seen


@compiled
def hide_behind_rectangle(points: Vector, eye: Vector, pose: Vector, bounds: Vector, start: float, seen: Mask) -> None:
    """Clear `seen` where the rectangle crosses the way from a point to `eye` more than `start` m from the point."""
    ends = np.empty((2, 3))
    for i in range(points.shape[0]):
        if not seen[i]:
            continue
        length = 0.0
        for k in range(3):
            ends[0, k], ends[1, k] = 0.0, 0.0
            for m in range(3):
                ends[0, k] += pose[m, k] * (points[i, m] - pose[m, 3])
                ends[1, k] += pose[m, k] * (eye[m] - pose[m, 3])
            length += (ends[1, k] - ends[0, k]) ** 2
        if (ends[0, 2] > 0.0) == (ends[1, 2] > 0.0):
            continue
        share = ends[0, 2] / (ends[0, 2] - ends[1, 2])
        x = ends[0, 0] + share * (ends[1, 0] - ends[0, 0])
        y = ends[0, 1] + share * (ends[1, 1] - ends[0, 1])
        if bounds[0] < x < bounds[1] and bounds[2] < y < bounds[3] and share * np.sqrt(length) > start:
            seen[i] = False


FADE = 0.1
"""Over this share of its angle the fan fades out."""
LOBE = 0.2
"""Half width, rad, of what a half-matt surface mirrors."""
WET = 0.6
"""Light of the stripe that a wet surface still scatters, of that of a dry one: the film keeps the rest inside."""
CAPILLARY = 1.8e-3
"""Length of oil, m, over which gravity flattens it: √(0.03 N/m / (900 kg/m³ · g))."""
HALO, HALO_AT = 0.35, 1.9
"""Light that comes out beside a wet stripe, of the stripe's, and how far from it, of the film's thickness."""


def angles(points: Vector, laser: LaserOptics) -> Vector:
    """Tangents (n,) of the angles from the fan's middle at which the laser sees points (n, 3), camera frame."""
    axis, across, origin = _fan(laser)
    way = points - origin
    return np.asarray((way @ across) / (way @ axis))


@lru_cache(maxsize=64)
def _fan(laser: LaserOptics) -> tuple[Vector, Vector, Vector]:
    normal, _, origin = laser_frame(laser)
    axis = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    axis /= np.linalg.norm(axis)
    return axis, np.cross(normal, axis), origin


def bend(columns: Vector, points: Vector, normals: Vector, intrinsics: Vector, laser: LaserOptics) -> None:
    """Move crossings, in place, from where the plane meets the surface to where the bowed sheet does, in their rows."""
    axis, across, origin = _fan(laser)
    way = points - origin
    sag = laser.bow * (way @ across) ** 2 / (way @ axis)
    slide(columns, points, normals, intrinsics=intrinsics, plane=laser_frame(laser)[0], sag=sag)


@compiled
def slide(columns: Vector, points: Vector, normals: Vector, intrinsics: Vector, plane: Vector, sag: Vector) -> None:
    """Core of `bend`: along the row, on the surface's tangent plane, until the point is `sag` off the plane."""
    for i in range(columns.shape[0]):
        gx, gy, gz = step_on_plane(points[i], normals[i], 1.0, 0.0, intrinsics)
        per_px = plane[0] * gx + plane[1] * gy + plane[2] * gz
        if not np.isfinite(per_px) or abs(per_px) < NARROWEST * points[i, 2] / intrinsics[0]:
            continue
        step = sag[i] / per_px
        columns[i] += step
        points[i, 0] += step * gx
        points[i, 1] += step * gy
        points[i, 2] += step * gz


def light_at(points: Vector, normals: Vector, laser: LaserOptics, grain: Grain | None) -> Vector:
    """Factors (n,) on the sheet's light at points (n, 3): its ends, the dust on its window, and the surface's gloss."""
    factor = np.ones(len(points))
    angle = np.arctan(angles(points, laser))
    if laser.end > 0.0:
        factor *= 0.5 - 0.5 * np.tanh((np.abs(angle) - laser.end) / (FADE * laser.end))
    for middle, half, share in laser.shadows:
        factor *= 1.0 - share * np.exp(-0.5 * ((angle - middle) / half) ** 2)
    if grain is not None and grain.gloss > 0.0:
        _, _, origin = laser_frame(laser)
        to_laser = origin - points
        to_laser /= np.linalg.norm(to_laser, axis=1)[:, None]
        to_eye = -points / np.linalg.norm(points, axis=1)[:, None]
        half_way = to_laser + to_eye
        half_way /= np.linalg.norm(half_way, axis=1)[:, None]
        facing = np.abs(np.einsum("ni,ni->n", half_way, normals))
        off = 2.0 * np.arccos(np.clip(facing, 0.0, 1.0))
        factor *= 1.0 + grain.gloss * np.exp(-0.5 * (off / LOBE) ** 2)
    return factor


def oiled(points: Vector, camera_from_mesh: Vector, puddle: Puddle | None) -> Vector:
    """How thick, m, the oil is at points (n, 3), camera frame: flat but for a rim where surface tension bends it.

    A wet surface scatters about 0.6 of a dry one's light (Lekner and Dorf, Applied Optics 27, 1278, 1988). Under a film
    of index 1.47, light that leaves the metal by more than 43° from the normal is mirrored at the film's surface. It
    meets the metal again 2 tan 43° = 1.9 thicknesses further on, and part of it leaves there: a halo. Metal that is
    half matt scatters forwards, away from the laser, and only this side is drawn. That the film also seems to lift the
    metal, by 0.3 thicknesses, is left out.
    """
    if puddle is None:
        return np.zeros(len(points))
    local = (points - camera_from_mesh[:3, 3]) @ camera_from_mesh[:3, :2]
    inside = np.maximum(0.0, puddle.radius - np.linalg.norm(local - puddle.centre, axis=1))
    return np.asarray(puddle.thickness * (1.0 - np.exp(-inside / CAPILLARY)))

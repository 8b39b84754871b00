"""A light sheet that is not perfect: bowed, fading at its ends, with shadows of dust; and surfaces that mirror it.

The fan's middle is the sheet's direction that is nearest to the camera's axis; y is across it, in the sheet.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import step_on_plane
from sim_backends.optics.compiled import compiled
from sim_backends.optics.laser.profile import NARROWEST
from sim_backends.optics.laser.visibility import laser_frame
from sim_backends.optics.scene import Grain, LaserOptics

Vector = NDArray[np.float64]

FADE = 0.1
"""Over this share of its angle the fan fades out."""
LOBE = 0.2
"""Half width, rad, of what a half-matt surface mirrors."""


def angles(points: Vector, laser: LaserOptics) -> Vector:
    """Tangents (n,) of the angles from the fan's middle at which the laser sees points (n, 3), camera frame."""
    axis, across, origin = _fan(laser)
    way = points - origin
    return np.asarray((way @ across) / (way @ axis))


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

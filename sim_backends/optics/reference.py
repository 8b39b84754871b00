"""The slow, physical picture of the stripe, to check the fast one: rays back from every sub-pixel through the lens.

Each ray finds the nearest triangle (Embree), takes the light of the laser sheet there, straight from its Gaussian
thickness, incidence, distance and shadow, and the picture is then blurred as light is, in two dimensions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from trimesh import Trimesh
from trimesh.ray import ray_pyembree

from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.profile import REFERENCE_RANGE
from sim_backends.optics.scene import LaserOptics, MeshInstance
from sim_backends.optics.visibility import laser_frame

Vector = NDArray[np.float64]


def reference_stripe(
    optics: CameraOptics,
    laser: LaserOptics,
    instance: MeshInstance,
    exposure: float,
    window: tuple[int, int, int, int],
    oversampling: int = 5,
) -> Vector:
    """Stripe without speckle on one mesh, in DN, for the pixels (u0, v0, u1, v1), ends excluded.

    `oversampling` sub-pixels along each axis, odd. Blur is that of the window's mean distance.
    """
    u0, v0, u1, v1 = window
    pad = 6
    n = oversampling
    u = (np.arange((u1 - u0 + 2 * pad) * n) + 0.5) / n + u0 - pad - 0.5
    v = (np.arange((v1 - v0 + 2 * pad) * n) + 0.5) / n + v0 - pad - 0.5
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    rays = np.column_stack([optics.undistort(grid.reshape(-1, 2)), np.ones(grid.shape[0] * grid.shape[1])])
    vertices = instance.mesh.vertices @ instance.camera_from_mesh[:3, :3].T + instance.camera_from_mesh[:3, 3]
    solid = Trimesh(vertices, instance.mesh.triangles, process=False)
    tracer: Any = ray_pyembree.RayMeshIntersector(solid)
    light = _sheet_light(solid, tracer, rays, laser) * instance.albedo * laser.brightness * exposure
    centre = np.array([(optics.width - 1) / 2, (optics.height - 1) / 2])
    corner = ((grid - centre) ** 2).sum(axis=-1) / (centre**2).sum()
    picture = light.reshape(grid.shape[:2]) * (1 - optics.vignetting * corner)
    hit = light > 0
    depth = _depths(solid, tracer, rays[hit]).mean() if hit.any() else optics.focus_distance
    picture = gaussian_filter(picture, float(optics.blur_px(depth)) * n, truncate=5)
    pixels = picture.reshape(len(v) // n, n, len(u) // n, n).mean(axis=(1, 3))
    return np.asarray(pixels[pad:-pad, pad:-pad])


def _first_hits(solid: Trimesh, tracer: Any, rays: Vector) -> tuple[NDArray[np.int64], Vector]:
    """Nearest triangle of each ray from the origin (−1 for none) and the point, in double precision."""
    found = np.asarray(tracer.intersects_first(np.zeros_like(rays), rays), dtype=np.int64)
    normals = solid.face_normals[found]
    anchors = solid.triangles[found, 0]
    share = np.einsum("ij,ij->i", normals, anchors) / np.einsum("ij,ij->i", normals, rays)
    return found, rays * share[:, None]


def _depths(solid: Trimesh, tracer: Any, rays: Vector) -> Vector:
    found, points = _first_hits(solid, tracer, rays)
    return np.asarray(points[found >= 0, 2])


def _sheet_light(solid: Trimesh, tracer: Any, rays: Vector, laser: LaserOptics) -> Vector:
    """Relative light (n,) of the laser sheet where rays (n, 3) from the camera first meet the mesh."""
    normal, distance, origin = laser_frame(laser)
    found, points = _first_hits(solid, tracer, rays)
    offset = points @ normal - distance
    near = (found >= 0) & (np.abs(offset) < 6 * laser.width)
    light = np.zeros(len(rays))
    points, faces = points[near], solid.face_normals[found[near]]
    way = origin - points
    span = np.linalg.norm(way, axis=1)
    incidence = np.einsum("ij,ij->i", faces, way) / span
    same_side = incidence * np.einsum("ij,ij->i", faces, -points) > 0
    shaded = np.asarray(tracer.intersects_any(points + 2e-5 * way / span[:, None], way))
    axis = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    in_fan = -(way @ axis) / np.linalg.norm(axis) / span > np.cos(laser.fan)
    sheet = np.exp(-0.5 * (offset[near] / laser.width) ** 2)
    light[near] = np.where(same_side & ~shaded & in_fan, sheet * np.abs(incidence) * REFERENCE_RANGE / span, 0.0)
    return light

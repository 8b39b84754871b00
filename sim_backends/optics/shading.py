"""Meshes in ambient light: the leaves of the box tree are splatted into a coarse depth buffer, then smoothed.

Good for the eye and for the stripe's background, not for measuring: silhouettes are true to a few pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.boards import ambient_dn, gain_parameters, pixel_gain
from sim_backends.optics.camera import CameraOptics, distort
from sim_backends.optics.compiled import compiled
from sim_backends.optics.scene import Light, MeshInstance

Vector = NDArray[np.float64]
Image = NDArray[np.float32]


def render_mesh(image: Image, optics: CameraOptics, instance: MeshInstance, light: Light, exposure: float) -> None:
    """Draw a mesh over `image` (height, width) in DN, shaded by the slope of its leaves."""
    pose = np.asarray(instance.camera_from_mesh, dtype=np.float64)
    mesh = instance.mesh
    centres = mesh.leaf_centres @ pose[:3, :3].T + pose[:3, 3]
    normals = mesh.leaf_normals @ pose[:3, :3].T
    distance = float(np.median(centres[:, 2]))
    if distance < 1e-3:
        return
    cell = int(np.clip(round(0.5 * float(np.median(mesh.leaf_sizes)) * optics.fx / distance), 1, 8))
    lamp = np.array((0.0, 0.0, -1.0) if light.direction is None else light.direction)
    shape = (optics.height // cell + 2, optics.width // cell + 2)
    depth = np.full(shape, np.inf)
    shade = np.zeros(shape)
    splat(centres, normals, mesh.leaf_sizes, optics.intrinsics, cell, lamp, light.diffuse, depth, shade)
    level = ambient_dn(optics, light, exposure) * instance.albedo
    spread(image, depth, shade, cell, level, gain_parameters(optics, light))


@compiled
def splat(
    centres: Vector,
    normals: Vector,
    sizes: Vector,
    intrinsics: Vector,
    cell: int,
    lamp: Vector,
    diffuse: float,
    depth: Vector,
    shade: Vector,
) -> None:
    """Nearest leaf wins in every cell of `cell` pixels; `shade` is its relative light."""
    for i in range(centres.shape[0]):
        z = centres[i, 2]
        if z < 1e-3:
            continue
        x, y = centres[i, 0] / z, centres[i, 1] / z
        if abs(x) > 1.0 or abs(y) > 1.0:
            continue
        u, v = distort(x, y, intrinsics)
        half = 0.5 * sizes[i] * intrinsics[0] / z / cell + 0.5
        c0, c1 = max(int(np.ceil(u / cell - half)), 0), min(int(np.floor(u / cell + half)), depth.shape[1] - 1)
        r0, r1 = max(int(np.ceil(v / cell - half)), 0), min(int(np.floor(v / cell + half)), depth.shape[0] - 1)
        if c1 < c0 or r1 < r0:
            continue
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        side = 1.0 if nx * x + ny * y + nz < 0.0 else -1.0
        value = diffuse + (1.0 - diffuse) * max(0.0, side * (nx * lamp[0] + ny * lamp[1] + nz * lamp[2]))
        for r in range(r0, r1 + 1):
            for c in range(c0, c1 + 1):
                if z < depth[r, c]:
                    depth[r, c] = z
                    shade[r, c] = value


@compiled
def spread(image: Image, depth: Vector, shade: Vector, cell: int, level: float, gain: Vector) -> None:
    """Lay the coarse shade over the image, bilinear between cells; empty cells let the image through."""
    for v in range(image.shape[0]):
        r = v // cell
        b = (v - r * cell) / cell
        for u in range(image.shape[1]):
            c = u // cell
            if not (depth[r, c] < np.inf or depth[r, c + 1] < np.inf):
                if not (depth[r + 1, c] < np.inf or depth[r + 1, c + 1] < np.inf):
                    continue
            a = (u - c * cell) / cell
            cover = 0.0
            value = 0.0
            for i in range(2):
                for j in range(2):
                    if depth[r + i, c + j] < np.inf:
                        weight = (b if i else 1.0 - b) * (a if j else 1.0 - a)
                        cover += weight
                        value += weight * shade[r + i, c + j]
            image[v, u] = image[v, u] * (1.0 - cover) + level * value * pixel_gain(u, v, gain)

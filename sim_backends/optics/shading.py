"""Meshes in ambient light: the leaves of the box tree are splatted into a coarse depth buffer, then smoothed.

Good for the eye and for the stripe's background, not for measuring: silhouettes are true to a few pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.blur import blur_window
from sim_backends.optics.camera import CameraOptics, distort
from sim_backends.optics.compiled import compiled, compiled_fast
from sim_backends.optics.lighting import ambient_dn, gain_parameters, pixel_gain
from sim_backends.optics.scene import Light, MeshInstance

Vector = NDArray[np.float64]
Image = NDArray[np.float32]


def render_mesh(image: Image, optics: CameraOptics, instance: MeshInstance, light: Light, exposure: float) -> None:
    """Draw a mesh over `image` (height, width) in DN, shaded by the slope of its leaves."""
    pose = np.asarray(instance.camera_from_mesh, dtype=np.float64)
    mesh = instance.mesh
    distance = float(pose[2, :3] @ mesh.middle + pose[2, 3])
    if distance < 1e-3:
        return
    cell = int(np.clip(round(0.9 * mesh.leaf_size * optics.fx / distance), 1, 12))
    lamp = pose[:3, :3].T @ np.array((0.0, 0.0, -1.0) if light.direction is None else light.direction)
    eye = -pose[:3, :3].T @ pose[:3, 3]
    shape = (optics.height // cell + 2, optics.width // cell + 2)
    depth = np.full(shape, np.inf)
    shade = np.zeros(shape)
    leaves = (mesh.leaf_centres, mesh.leaf_normals, mesh.leaf_sizes)
    splat(*leaves, np.ascontiguousarray(pose), eye, optics.intrinsics, cell, lamp, light.diffuse, depth, shade)
    level = ambient_dn(optics, light, exposure) * instance.albedo
    cover = np.isfinite(depth).astype(np.float32)
    relative = shade.astype(np.float32)
    whole = (0, 0, shape[1], shape[0])
    blur_window(cover, whole, 0.8)
    blur_window(relative, whole, 0.8)
    columns = np.arange(optics.width, dtype=np.int32)
    cell_of = columns // np.int32(cell)
    share_of = (columns / cell - cell_of).astype(np.float32)
    gain = gain_parameters(optics, light)
    spread(image, cover, relative, cell=cell, cell_of=cell_of, share_of=share_of, level=level, gain=gain)


@compiled
def splat(
    centres: Vector,
    normals: Vector,
    sizes: Vector,
    pose: Vector,
    eye: Vector,
    intrinsics: Vector,
    cell: int,
    lamp: Vector,
    diffuse: float,
    depth: Vector,
    shade: Vector,
) -> None:
    """Nearest leaf wins in every cell of `cell` pixels; `shade` is its relative light. Leaves, `eye` and
    `lamp` are in the mesh frame."""
    for i in range(centres.shape[0]):
        a, b, c = centres[i, 0], centres[i, 1], centres[i, 2]
        z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
        if z < 1e-3:
            continue
        x = (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]) / z
        y = (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]) / z
        if abs(x) > 1.0 or abs(y) > 1.0:
            continue
        u, v = distort(x, y, intrinsics)
        half = 0.5 * sizes[i] * intrinsics[0] / z / cell + 0.5
        c0, c1 = max(int(np.ceil(u / cell - half)), 0), min(int(np.floor(u / cell + half)), depth.shape[1] - 1)
        r0, r1 = max(int(np.ceil(v / cell - half)), 0), min(int(np.floor(v / cell + half)), depth.shape[0] - 1)
        if c1 < c0 or r1 < r0:
            continue
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        side = 1.0 if nx * (eye[0] - a) + ny * (eye[1] - b) + nz * (eye[2] - c) > 0.0 else -1.0
        value = diffuse + (1.0 - diffuse) * max(0.0, side * (nx * lamp[0] + ny * lamp[1] + nz * lamp[2]))
        for row in range(r0, r1 + 1):
            for column in range(c0, c1 + 1):
                if z < depth[row, column]:
                    depth[row, column] = z
                    shade[row, column] = value


@compiled_fast
def spread(
    image: Image,
    cover: Image,
    shade: Image,
    cell: int,
    cell_of: NDArray[np.int32],
    share_of: Image,
    level: float,
    gain: Vector,
) -> None:
    """Lay the coarse shade over the image, bilinear between cells; where nothing covers, the image stays."""
    rows, cols = image.shape
    cells = cover.shape[1]
    cover_line = np.empty(cells, dtype=np.float32)
    shade_line = np.empty(cells, dtype=np.float32)
    one = np.float32(1.0)
    for v in range(rows):
        r = v // cell
        b = np.float32((v - r * cell) / cell)
        any_cover = False
        for c in range(cells):
            cover_line[c] = cover[r, c] + b * (cover[r + 1, c] - cover[r, c])
            light = level * pixel_gain(c * cell, v, gain)
            shade_line[c] = light * (shade[r, c] + b * (shade[r + 1, c] - shade[r, c]))
            any_cover |= cover_line[c] > 0.0
        if not any_cover:
            continue
        line = image[v]
        for u in range(cols):
            c = cell_of[u]
            a = share_of[u]
            covered = cover_line[c] + a * (cover_line[c + 1] - cover_line[c])
            line[u] = line[u] * (one - covered) + shade_line[c] + a * (shade_line[c + 1] - shade_line[c])

"""Ambient light: how bright a surface appears, its variation over the picture, a strip of sunlight, meshes.

Meshes are splatted from the leaves of their box tree into a coarse depth buffer and smoothed: good for the eye and for
the stripe's background, not for measuring. Silhouettes are true to a few pixels.
"""

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import CameraOptics, blur_window, distort
from sim_backends.optics.compiled import compiled, compiled_fast
from sim_backends.optics.scene import Light, MeshInstance, Sun

Vector = NDArray[np.float64]
Image = NDArray[np.float32]

AMBIENT_RATE = 25_000.0
"""DN per second of a facing surface of albedo 1 in light of level 1, without a filter, in the image's centre."""


def ambient_dn(optics: CameraOptics, light: Light, exposure: float) -> float:
    """DN in the image's centre of a surface of albedo 1 that faces the light, after `exposure` seconds."""
    return AMBIENT_RATE * light.level * optics.transmission * exposure


def lambert(light: Light, normal: Vector) -> float:
    """Relative light on a surface of unit `normal` (camera frame, towards the camera)."""
    lamp = (0.0, 0.0, -1.0) if light.direction is None else light.direction
    return light.diffuse + (1 - light.diffuse) * max(0.0, float(np.dot(normal, lamp)))


def gain_parameters(optics: CameraOptics, light: Light) -> Vector:
    """(6,) centre, inverse corner radius², vignetting and gradients per pixel: what `pixel_gain` takes."""
    centre_u, centre_v = (optics.width - 1) / 2, (optics.height - 1) / 2
    return np.array(
        [
            centre_u,
            centre_v,
            1 / (centre_u**2 + centre_v**2),
            optics.vignetting,
            light.gradient[0] / optics.width,
            light.gradient[1] / optics.height,
        ]
    )


@compiled
def pixel_gain(u: float, v: float, gain: Vector) -> float:
    """Vignetting times ambient gradient at a pixel."""
    a = u - gain[0]
    b = v - gain[1]
    return float((1.0 - gain[3] * (a * a + b * b) * gain[2]) * (1.0 + gain[4] * a + gain[5] * b))


@compiled_fast
def gain_line(line: Image, u0: int, v: int, level: float, gain: Vector) -> None:
    """Set `line`, the pixels of row v from column u0 on, to `level` DN times the gain."""
    centre_u, vignetting, slope = np.float32(gain[0] - u0), np.float32(gain[3] * gain[2]), np.float32(gain[4])
    b = np.float32(v - gain[1])
    middle = np.float32(1.0) - vignetting * b * b
    tilt = np.float32(1.0 + gain[5] * b)
    scale = np.float32(level)
    for u in range(line.shape[0]):
        a = np.float32(u) - centre_u
        line[u] = scale * (middle - vignetting * a * a) * (tilt + slope * a)


@compiled
def fill_background(image: Image, level: float, gain: Vector) -> None:
    """Set the whole image to `level` DN times the gain."""
    for v in range(image.shape[0]):
        gain_line(image[v], 0, v, level, gain)


EDGE = 0.004
"""Width of the strip's edges, m: the sun is half a degree wide and the window some metres away."""


def add_sun(image: Image, optics: CameraOptics, sun: Sun) -> None:
    """Brighten `image` (height, width), DN, where the pixels' rays meet the strip; lens distortion is left out."""
    pose = sun.camera_from_ground
    to_ground = np.linalg.inv(np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    to_rays = np.linalg.inv(np.array([[optics.fx, 0.0, optics.cx], [0.0, optics.fy, optics.cy], [0.0, 0.0, 1.0]]))
    brighten(image, to_ground @ to_rays, sun.low, sun.high, sun.strength)


@compiled
def brighten(image: Image, to_ground: Vector, low: float, high: float, strength: float) -> None:
    """Core of `add_sun`; `to_ground` (3, 3) takes pixels to homogeneous places on the ground."""
    h = to_ground
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
            if weight <= 0.0:
                continue
            x = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / weight
            inside = min((x - low) / EDGE, (high - x) / EDGE)
            if inside > 0.0:
                image[v, u] *= 1.0 + strength * min(1.0, inside)


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
    centres: Vector, normals: Vector, sizes: Vector, pose: Vector, eye: Vector, intrinsics: Vector, cell: int,
    lamp: Vector, diffuse: float, depth: Vector, shade: Vector,
) -> None:  # fmt: skip
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
    image: Image, cover: Image, shade: Image, cell: int, cell_of: NDArray[np.int32], share_of: Image, level: float,
    gain: Vector,
) -> None:  # fmt: skip
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

"""Boards and plain rectangles as the camera sees them in ambient light: perspective, distortion, edges, shading.

Every pixel whose footprint is crossed by an edge is averaged over eight scan lines, each with the exact chord of the
dot or square; all others take the albedo at their centre. The centroid of a dot is then true to 0.002 px.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.blur import blur_window
from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.compiled import compiled
from sim_backends.optics.scene import KINDS, Board, BoardInstance, Light, PlaneInstance

Vector = NDArray[np.float64]
Image = NDArray[np.float32]
Window = tuple[int, int, int, int]

AMBIENT_RATE = 25_000.0
"""DN per second of a facing surface of albedo 1 in light of level 1, without a filter, in the image's centre."""
PLAIN, MARKED, ASYMMETRIC, DOTS, CHESS = range(5)


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


def pattern_parameters(board: Board) -> Vector:
    """(12,) kind, cols, rows, pitch, bounds, albedos and dot radius: what the kernels take."""
    return np.array(
        [
            KINDS.index(board.kind),
            board.cols,
            board.rows,
            board.pitch,
            *board.bounds,
            board.white,
            board.black,
            board.dot_radius,
            board.dot_radius / 2,
        ]
    )


def plain_parameters(bounds: tuple[float, float, float, float], albedo: float) -> Vector:
    """Parameters of a rectangle without a pattern, same layout as `pattern_parameters`."""
    return np.array([PLAIN, 1, 1, 1.0, *bounds, albedo, albedo, 0.0, 0.0])


def appearance(instance: BoardInstance | PlaneInstance) -> tuple[Vector, Vector]:
    """Pose of the rectangle in the camera frame and the parameters of the side that the camera sees."""
    if isinstance(instance, PlaneInstance):
        half = (instance.size[0] / 2, instance.size[1] / 2)
        return instance.camera_from_plane, plain_parameters((-half[0], half[0], -half[1], half[1]), instance.albedo)
    pose = np.asarray(instance.camera_from_board, dtype=np.float64)
    if pose[:3, 2] @ pose[:3, 3] > 0:
        return pose, pattern_parameters(instance.board)
    return pose, plain_parameters(instance.board.bounds, 0.5 * instance.board.white)


def render_rectangle(
    image: Image, optics: CameraOptics, instance: BoardInstance | PlaneInstance, light: Light, exposure: float
) -> None:
    """Draw a board or plane over `image` (height, width) in DN; what is behind the camera or outside is skipped."""
    pose, pattern = appearance(instance)
    window = visible_window(optics, pose, pattern)
    if window is None:
        return
    normal = pose[:3, 2] * -np.sign(pose[:3, 2] @ pose[:3, 3])
    offset = abs(float(normal @ pose[:3, 3]))
    if offset < 1e-9:
        return
    inverse = np.linalg.inv(np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    level = ambient_dn(optics, light, exposure) * lambert(light, normal)
    x, y = optics.rays()
    edges = draw(
        image, x, y, inverse, pattern, np.array(window), offset, optics.fx, level, gain_parameters(optics, light)
    )
    if edges:
        blur_window(image, window, float(optics.blur_px(_distance(pose, pattern))))


def visible_window(optics: CameraOptics, pose: Vector, pattern: Vector) -> Window | None:
    """Pixels (u0, v0, u1, v1) that the rectangle may cover, with room for its blur; None when it is out of view."""
    x0, x1, y0, y1 = pattern[4:8]
    ring = np.linspace(0.0, 1.0, 9)
    a = np.concatenate([x0 + (x1 - x0) * ring, x0 + (x1 - x0) * ring, np.full(9, x0), np.full(9, x1)])
    b = np.concatenate([np.full(9, y0), np.full(9, y1), y0 + (y1 - y0) * ring, y0 + (y1 - y0) * ring])
    points = np.column_stack([a, b, np.zeros(36)]) @ pose[:3, :3].T + pose[:3, 3]
    if (points[:, 2] < 1e-3).all():
        return None
    if (points[:, 2] < 1e-3).any():
        return 0, 0, optics.width, optics.height
    # Far outside the picture the distortion polynomial folds back, so the rays are held near the picture's cone.
    reach = 1.5 * max(optics.width / optics.fx, optics.height / optics.fy)
    rays = np.clip(points / points[:, 2:], -reach, reach)
    pixels = optics.project(np.ascontiguousarray(rays))
    room = 2 + np.ceil(4 * float(optics.blur_px(_distance(pose, pattern))))
    low = np.maximum(np.floor(pixels.min(axis=0)) - room, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + room + 1, [optics.width, optics.height])
    if (low >= high).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _distance(pose: Vector, pattern: Vector) -> float:
    centre = np.array([(pattern[4] + pattern[5]) / 2, (pattern[6] + pattern[7]) / 2, 0.0])
    return max(float(pose[2, :3] @ centre + pose[2, 3]), 1e-3)


@compiled
def pixel_gain(u: float, v: float, gain: Vector) -> float:
    """Vignetting times ambient gradient at a pixel."""
    a = u - gain[0]
    b = v - gain[1]
    return (1.0 - gain[3] * (a * a + b * b) * gain[2]) * (1.0 + gain[4] * a + gain[5] * b)


@compiled
def fill_background(image: Image, level: float, gain: Vector) -> None:
    """Set the whole image to `level` DN times the gain."""
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            image[v, u] = level * pixel_gain(u, v, gain)


@compiled
def nearest_dot(bx: float, by: float, pattern: Vector) -> tuple[float, float, bool, bool]:
    """Centre of the dot nearest to a point of the board, whether there is one, and whether it is a ring."""
    kind, cols, rows, pitch = int(pattern[0]), int(pattern[1]), int(pattern[2]), pattern[3]
    j = min(max(int(np.floor(by / pitch + 0.5)), 0), rows - 1)
    if kind == ASYMMETRIC:
        shift = j % 2
        i = min(max(int(np.floor((bx / pitch - shift) / 2.0 + 0.5)), 0), cols - 1)
        return (2 * i + shift) * pitch, j * pitch, True, False
    i = min(max(int(np.floor(bx / pitch + 0.5)), 0), cols - 1)
    c, r = (cols - 1) // 2, (rows - 1) // 2
    ring = kind == MARKED and ((j == r and (i == c or i == c + 2)) or (j == r + 1 and i == c))
    return i * pitch, j * pitch, True, ring


@compiled
def albedo_at(bx: float, by: float, pattern: Vector) -> float:
    """Albedo of the board at a point inside its bounds."""
    kind = int(pattern[0])
    if kind == PLAIN:
        return pattern[8]
    if kind == CHESS:
        p = pattern[3]
        a, b = int(np.floor(bx / p)), int(np.floor(by / p))
        inside = a >= -1 and b >= -1 and a < pattern[1] and b < pattern[2]
        return pattern[9] if inside and (a + b) % 2 == 0 else pattern[8]
    x, y, _, ring = nearest_dot(bx, by, pattern)
    d2 = (bx - x) ** 2 + (by - y) ** 2
    if d2 > pattern[10] ** 2 or (ring and d2 < pattern[11] ** 2):
        return pattern[8]
    return pattern[9]


@compiled
def near_edge(bx: float, by: float, reach: float, pattern: Vector) -> bool:
    """Whether an edge of the pattern passes within `reach` (m on the board) of a point."""
    kind = int(pattern[0])
    if kind == PLAIN:
        return False
    if kind == CHESS:
        p = pattern[3]
        return abs(bx - p * np.floor(bx / p + 0.5)) < reach or abs(by - p * np.floor(by / p + 0.5)) < reach
    x, y, _, ring = nearest_dot(bx, by, pattern)
    d = np.sqrt((bx - x) ** 2 + (by - y) ** 2)
    return abs(d - pattern[10]) < reach or (ring and abs(d - pattern[11]) < reach)


@compiled
def chord(x: float, y: float, dx: float, dy: float, radius: float) -> float:
    """Share of the segment (x, y) … (x + dx, y + dy) inside the circle of `radius` about the origin."""
    a = dx * dx + dy * dy
    b = x * dx + y * dy
    c = x * x + y * y - radius * radius
    root = b * b - a * c
    if root <= 0.0:
        return 0.0
    root = np.sqrt(root)
    return max(0.0, min(1.0, (-b + root) / a) - max(0.0, (-b - root) / a))


@compiled
def segment_albedo(x: float, y: float, dx: float, dy: float, pattern: Vector) -> float:
    """Mean albedo along a segment of the board that is shorter than the pattern's details."""
    kind = int(pattern[0])
    if kind == PLAIN:
        return pattern[8]
    if kind == CHESS:
        p = pattern[3]
        ends = np.array([0.0, 1.0, 1.0, 1.0])
        line = p * np.floor((x + 0.5 * dx) / p + 0.5)
        if dx != 0.0 and 0.0 < (line - x) / dx < 1.0:
            ends[1] = (line - x) / dx
        line = p * np.floor((y + 0.5 * dy) / p + 0.5)
        if dy != 0.0 and 0.0 < (line - y) / dy < 1.0:
            ends[2] = (line - y) / dy
        if ends[1] > ends[2]:
            ends[1], ends[2] = ends[2], ends[1]
        mean = 0.0
        for i in range(3):
            middle = 0.5 * (ends[i] + ends[i + 1])
            mean += (ends[i + 1] - ends[i]) * albedo_at(x + middle * dx, y + middle * dy, pattern)
        return mean
    cx, cy, _, ring = nearest_dot(x + 0.5 * dx, y + 0.5 * dy, pattern)
    dark = chord(x - cx, y - cy, dx, dy, pattern[10])
    if ring:
        dark -= chord(x - cx, y - cy, dx, dy, pattern[11])
    return pattern[8] + dark * (pattern[9] - pattern[8])


@compiled
def covered(x: float, dx: float, low: float, high: float, start: float, end: float) -> tuple[float, float]:
    """Clip the parameter interval (start, end) of x + s dx to low … high."""
    if dx == 0.0:
        return (start, end) if low <= x <= high else (start, start)
    a = (low - x) / dx
    b = (high - x) / dx
    return max(start, min(a, b)), min(end, max(a, b))


@compiled
def draw(
    image: Image,
    ray_x: Image,
    ray_y: Image,
    inverse: Vector,
    pattern: Vector,
    window: NDArray[np.int64],
    offset: float,
    focal_px: float,
    level: float,
    gain: Vector,
) -> int:
    """Draw the rectangle; `inverse` maps a ray to (bx, by, 1)/Z. Returns the number of edge pixels."""
    lines = 8
    u0, v0, u1, v1 = window[0], window[1], window[2], window[3]
    x0, x1, y0, y1 = pattern[4], pattern[5], pattern[6], pattern[7]
    last_u, last_v = image.shape[1] - 1, image.shape[0] - 1
    edges = 0
    for v in range(v0, v1):
        above, below = max(v - 1, 0), min(v + 1, last_v)
        for u in range(u0, u1):
            x, y = ray_x[v, u], ray_y[v, u]
            w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
            if w <= 0.0:
                continue
            depth = 1.0 / w
            bx = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) * depth
            by = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) * depth
            reach = 0.85 * depth * depth / (focal_px * offset)
            if bx < x0 - reach or bx > x1 + reach or by < y0 - reach or by > y1 + reach:
                continue
            inside = bx > x0 + reach and bx < x1 - reach and by > y0 + reach and by < y1 - reach
            light = level * pixel_gain(u, v, gain)
            if inside and not near_edge(bx, by, reach, pattern):
                image[v, u] = light * albedo_at(bx, by, pattern)
                continue
            edges += 1
            left, right = max(u - 1, 0), min(u + 1, last_u)
            xu = (ray_x[v, right] - ray_x[v, left]) / (right - left)
            yu = (ray_y[v, right] - ray_y[v, left]) / (right - left)
            xv = (ray_x[below, u] - ray_x[above, u]) / (below - above)
            yv = (ray_y[below, u] - ray_y[above, u]) / (below - above)
            wu = inverse[2, 0] * xu + inverse[2, 1] * yu
            wv = inverse[2, 0] * xv + inverse[2, 1] * yv
            bxu = (inverse[0, 0] * xu + inverse[0, 1] * yu - bx * wu) * depth
            byu = (inverse[1, 0] * xu + inverse[1, 1] * yu - by * wu) * depth
            bxv = (inverse[0, 0] * xv + inverse[0, 1] * yv - bx * wv) * depth
            byv = (inverse[1, 0] * xv + inverse[1, 1] * yv - by * wv) * depth
            albedo = 0.0
            cover = 0.0
            for line in range(lines):
                t = (line + 0.5) / lines - 0.5
                sx = bx + t * bxv - 0.5 * bxu
                sy = by + t * byv - 0.5 * byu
                start, end = 0.0, 1.0
                if not inside:
                    start, end = covered(sx, bxu, x0, x1, start, end)
                    start, end = covered(sy, byu, y0, y1, start, end)
                if end > start:
                    length = end - start
                    cover += length
                    albedo += length * segment_albedo(
                        sx + start * bxu, sy + start * byu, length * bxu, length * byu, pattern
                    )
            image[v, u] = (image[v, u] * (lines - cover) + light * albedo) / lines
    return edges

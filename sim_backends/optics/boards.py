"""Boards and plain rectangles as the camera sees them in ambient light: perspective, distortion, edges, shading.

Every pixel whose footprint is crossed by an edge is averaged over eight scan lines, each with the exact chord of the
dot or square; all others take the albedo at their centre. The centroid of a dot is then true to 0.002 px,
which is what integrating over square pixels costs by itself.
"""

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import CameraOptics, blur_window
from sim_backends.optics.compiled import compiled, compiled_fast
from sim_backends.optics.lighting import ambient_dn, fill_background, gain_line, gain_parameters, lambert
from sim_backends.optics.pattern import (
    CHESS,
    EDGE,
    PLAIN,
    chess_share,
    classify,
    disc_share,
    nearest_dot,
    pattern_parameters,
    plain_parameters,
    rectangle_share,
)
from sim_backends.optics.scene import BoardInstance, Light, PlaneInstance

Vector = NDArray[np.float64]
Image = NDArray[np.float32]
Window = tuple[int, int, int, int]


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
    normal = pose[:3, 2] * -np.sign(pose[:3, 2] @ pose[:3, 3])
    offset = abs(float(normal @ pose[:3, 3]))
    if offset < 1e-9:
        return
    inverse = np.linalg.inv(np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    level = ambient_dn(optics, light, exposure) * lambert(light, normal)
    x, y = optics.rays()
    if pattern[0] == PLAIN and _fills(x, y, inverse, pattern):
        fill_background(image, level * pattern[8], gain_parameters(optics, light))
        return
    window = visible_window(optics, pose, pattern)
    if window is None:
        return
    edges = draw(
        image, x, y, inverse=inverse, pattern=pattern, window=np.array(window), offset=offset, focal_px=optics.fx,
        level=level, gain=gain_parameters(optics, light),
    )  # fmt: skip
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
    rays = points / points[:, 2:]
    rays[:, :2] = np.clip(rays[:, :2], -reach, reach)
    pixels = optics.project(rays)
    room = 2 + np.ceil(4 * float(optics.blur_px(_distance(pose, pattern))))
    low = np.maximum(np.floor(pixels.min(axis=0)) - room, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + room + 1, [optics.width, optics.height])
    if (low >= high).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _fills(x: Image, y: Image, inverse: Vector, pattern: Vector) -> bool:
    """Whether the picture's rim, and so all of it, shows the rectangle."""
    step = 16
    rim_x = np.concatenate([x[0, ::step], x[-1, ::step], x[::step, 0], x[::step, -1], x[-1:, -1]])
    rim_y = np.concatenate([y[0, ::step], y[-1, ::step], y[::step, 0], y[::step, -1], y[-1:, -1]])
    a, b, w = inverse @ np.stack([rim_x, rim_y, np.ones_like(rim_x)])
    x0, x1, y0, y1 = pattern[4:8]
    return bool(
        (w > 0).all() and (a > x0 * w).all() and (a < x1 * w).all() and (b > y0 * w).all() and (b < y1 * w).all()
    )


def _distance(pose: Vector, pattern: Vector) -> float:
    centre = np.array([(pattern[4] + pattern[5]) / 2, (pattern[6] + pattern[7]) / 2, 0.0])
    return max(float(pose[2, :3] @ centre + pose[2, 3]), 1e-3)


@compiled
def draw(
    image: Image, ray_x: Image, ray_y: Image, inverse: Vector, pattern: Vector, window: NDArray[np.int64],
    offset: float, focal_px: float, level: float, gain: Vector,
) -> int:  # fmt: skip
    """Draw the rectangle; `inverse` maps a ray to (bx, by, 1)/Z. Returns the number of edge pixels."""
    u0, v0, u1, v1 = window[0], window[1], window[2], window[3]
    board = np.empty((3, u1 - u0), dtype=np.float64)
    albedo = np.empty(u1 - u0, dtype=np.float32)
    light = np.empty(u1 - u0, dtype=np.float32)
    edges = 0
    for v in range(v0, v1):
        locate(ray_x[v, u0:u1], ray_y[v, u0:u1], inverse, 0.85 / (focal_px * offset), board)
        classify(board, pattern, albedo)
        gain_line(light, u0, v, level, gain)
        line = image[v, u0:u1]
        for u in range(u1 - u0):
            if albedo[u] >= 0.0:
                line[u] = light[u] * albedo[u]
            elif albedo[u] == EDGE:
                edges += 1
                cover, shade = edge_pixel(ray_x, ray_y, u + u0, v=v, inverse=inverse, pattern=pattern)
                line[u] = line[u] * (1.0 - cover) + light[u] * cover * shade
    return edges


@compiled_fast
def locate(ray_x: Image, ray_y: Image, inverse: Vector, footprint: float, board: Vector) -> None:
    """For a line of rays: where they meet the board, and the reach of a pixel on it (negative behind the camera)."""
    a, b, c = inverse[0, 0], inverse[0, 1], inverse[0, 2]
    d, e, f = inverse[1, 0], inverse[1, 1], inverse[1, 2]
    g, h, i = inverse[2, 0], inverse[2, 1], inverse[2, 2]
    for u in range(ray_x.shape[0]):
        x, y = ray_x[u], ray_y[u]
        w = g * x + h * y + i
        depth = 1.0 / w
        board[0, u] = (a * x + b * y + c) * depth
        board[1, u] = (d * x + e * y + f) * depth
        board[2, u] = footprint * depth * depth if w > 1e-9 else -1e9


@compiled
def edge_pixel(ray_x: Image, ray_y: Image, u: int, v: int, inverse: Vector, pattern: Vector) -> tuple[float, float]:
    """Share of a pixel that the rectangle covers, and the mean albedo of that share."""
    left, right = max(u - 1, 0), min(u + 1, ray_x.shape[1] - 1)
    above, below = max(v - 1, 0), min(v + 1, ray_x.shape[0] - 1)
    x, y = ray_x[v, u], ray_y[v, u]
    depth = 1.0 / (inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2])
    bx = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) * depth
    by = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) * depth
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
    wide, tall = abs(bxu) + abs(bxv), abs(byu) + abs(byv)
    # Scan lines have to run across the edge, not along it: swap the pixel's sides if need be.
    if not (pattern[4] + wide < bx < pattern[5] - wide and pattern[6] + tall < by < pattern[7] - tall):
        # No detail of a pattern reaches the rim.
        to_x = min(abs(bx - pattern[4]), abs(bx - pattern[5])) / wide
        to_y = min(abs(by - pattern[6]), abs(by - pattern[7])) / tall
        if (abs(bxu) < abs(bxv)) if to_x < to_y else (abs(byu) < abs(byv)):
            bxu, byu, bxv, byv = bxv, byv, bxu, byu
        return rectangle_share(bx, by, bxu, yu=byu, xv=bxv, yv=byv, pattern=pattern), pattern[8]
    kind = int(pattern[0])
    if kind == PLAIN:
        return 1.0, pattern[8]
    if kind == CHESS:
        p = pattern[3]
        to_x = abs(bx - p * np.floor(bx / p + 0.5)) / wide
        to_y = abs(by - p * np.floor(by / p + 0.5)) / tall
        if (abs(bxu) < abs(bxv)) if to_x < to_y else (abs(byu) < abs(byv)):
            bxu, byu, bxv, byv = bxv, byv, bxu, byu
        return 1.0, chess_share(bx, by, bxu, yu=byu, xv=bxv, yv=byv, pattern=pattern)
    dot_x, dot_y, ring = nearest_dot(bx, by, pattern)
    dx, dy = bx - dot_x, by - dot_y
    if abs(dx * bxu + dy * byu) < abs(dx * bxv + dy * byv):
        bxu, byu, bxv, byv = bxv, byv, bxu, byu
    dark = disc_share(dx, dy, bxu, yu=byu, xv=bxv, yv=byv, radius=pattern[10])
    if ring:
        dark -= disc_share(dx, dy, bxu, yu=byu, xv=bxv, yv=byv, radius=pattern[11])
    return 1.0, pattern[8] + dark * (pattern[9] - pattern[8])

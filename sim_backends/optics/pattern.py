"""What is printed on a board: its albedo at a point, along a line of pixels, and averaged over an edge pixel.

A pattern travels through the kernels as one array of twelve numbers, see `pattern_parameters`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled
from sim_backends.optics.scene import KINDS, Board, Grain

Vector = NDArray[np.float64]
Image = NDArray[np.float32]

PLAIN, MARKED, ASYMMETRIC, DOTS, CHESS, GRAIN = range(6)
GRAINS = (0.3e-3, 1.0e-3)
"""Sizes of a texture's grains, m; each has half of its variance."""
SPOT_CELL = 5e-3
"""In each square of this edge there is at most one spot of dust, of albedo a sixth."""
EDGE, OUTSIDE = -1.0, -2.0
LINES = 8
"""Scan lines through an edge pixel."""


def pattern_parameters(board: Board) -> Vector:
    """(12,) kind, cols, rows, pitch, bounds, albedos and dot radius: what the kernels take."""
    dot = board.dot_radius
    return np.array([
        KINDS.index(board.kind), board.cols, board.rows, board.pitch, *board.bounds, board.white, board.black, dot,
        dot / 2,
    ])  # fmt: skip


def plain_parameters(bounds: tuple[float, float, float, float], albedo: float) -> Vector:
    """Parameters of a rectangle without a pattern, same layout as `pattern_parameters`."""
    return np.array([PLAIN, 1, 1, 1.0, *bounds, albedo, albedo, 0.0, 0.0])


def grain_parameters(albedo: float, grain: Grain | None) -> Vector:
    """Parameters of a surface without an end, same layout: its spots' share of cells and its texture's RMS."""
    made = plain_parameters((0.0, 0.0, 0.0, 0.0), albedo)
    if grain is not None and (grain.texture > 0.0 or grain.spots > 0.0):
        made[0] = GRAIN
        made[1], made[2] = min(1.0, grain.spots * 1e4 * SPOT_CELL**2), grain.texture
    return made


@compiled
def chance(i: int, j: int, salt: int) -> float:
    """A number from 0 to 1 that belongs to the cell (i, j)."""
    z = (i * 73856093) ^ (j * 19349663) ^ (salt * 83492791)
    z = (z ^ (z >> 13)) * 1274126177 & 0x7FFFFFFF
    z = (z ^ (z >> 16)) * 668265263 & 0x7FFFFFFF
    return float((z ^ (z >> 15)) & 0xFFFFFF) / 16777216.0


@compiled
def grain_at(bx: float, by: float, pattern: Vector) -> float:
    """Albedo of a textured, dusty surface: smoothed chance at the corners of two grids, then the spots."""
    value = 0.0
    for k in range(2):
        x, y = bx / GRAINS[k], by / GRAINS[k]
        i, j = math.floor(x), math.floor(y)
        a, b = x - i, y - j
        a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
        low = (1.0 - a) * chance(i, j, k) + a * chance(i + 1, j, k)
        high = (1.0 - a) * chance(i, j + 1, k) + a * chance(i + 1, j + 1, k)
        value += (1.0 - b) * low + b * high - 0.5
    # Even chances have a variance of 1/12, of which the smoothing keeps 0.55.
    albedo = pattern[8] * max(0.1, 1.0 + pattern[2] * 3.3 * value)
    i, j = math.floor(bx / SPOT_CELL), math.floor(by / SPOT_CELL)
    if chance(i, j, 2) < pattern[1]:
        x = (i + 0.15 + 0.7 * chance(i, j, 3)) * SPOT_CELL
        y = (j + 0.15 + 0.7 * chance(i, j, 4)) * SPOT_CELL
        radius = 0.2e-3 + 0.3e-3 * chance(i, j, 5)
        if (bx - x) ** 2 + (by - y) ** 2 < radius * radius:
            albedo = pattern[8] / 6.0
    return float(albedo)


@compiled
def nearest_dot(bx: float, by: float, pattern: Vector) -> tuple[float, float, bool]:
    """Centre of the dot nearest to a point of the board, and whether it is a ring."""
    kind, cols, rows, pitch = int(pattern[0]), int(pattern[1]), int(pattern[2]), pattern[3]
    j = min(max(math.floor(by / pitch + 0.5), 0), rows - 1)
    if kind == ASYMMETRIC:
        shift = j % 2
        i = min(max(math.floor((bx / pitch - shift) / 2.0 + 0.5), 0), cols - 1)
        return float((2 * i + shift) * pitch), float(j * pitch), False
    i = min(max(math.floor(bx / pitch + 0.5), 0), cols - 1)
    c, r = (cols - 1) // 2, (rows - 1) // 2
    ring = kind == MARKED and ((j == r and (i == c or i == c + 2)) or (j == r + 1 and i == c))
    return float(i * pitch), float(j * pitch), ring


@compiled
def albedo_at(bx: float, by: float, pattern: Vector) -> float:
    """Albedo of the board at a point inside its bounds."""
    kind = int(pattern[0])
    if kind == PLAIN:
        return float(pattern[8])
    if kind == GRAIN:
        return grain_at(bx, by, pattern)
    if kind == CHESS:
        p = pattern[3]
        a, b = math.floor(bx / p), math.floor(by / p)
        inside = a >= -1 and b >= -1 and a < pattern[1] and b < pattern[2]
        return float(pattern[9] if inside and (a + b) % 2 == 0 else pattern[8])
    x, y, ring = nearest_dot(bx, by, pattern)
    d2 = (bx - x) ** 2 + (by - y) ** 2
    if d2 > pattern[10] ** 2 or (ring and d2 < pattern[11] ** 2):
        return float(pattern[8])
    return float(pattern[9])


@compiled
def dotted(bx: float, by: float, reach: float, pattern: Vector) -> float:
    """Albedo of a point inside a board of dots where it is sure, `EDGE` where a dot's edge is within `reach` m."""
    kind, cols, rows, p = int(pattern[0]), int(pattern[1]), int(pattern[2]), pattern[3]
    white, black, outer, inner = pattern[8], pattern[9], pattern[10], pattern[11]
    ring_col, ring_row = (cols - 1) // 2, (rows - 1) // 2
    per_pitch = 1.0 / p
    j = min(max(int(by * per_pitch + 1.5) - 1, 0), rows - 1)
    if kind == ASYMMETRIC:
        shift = j & 1
        i = 2 * min(max(int((bx * per_pitch - shift) * 0.5 + 1.5) - 1, 0), cols - 1) + shift
    else:
        i = min(max(int(bx * per_pitch + 1.5) - 1, 0), cols - 1)
    dx, dy = bx - i * p, by - j * p
    d2 = dx * dx + dy * dy
    if d2 > (outer + reach) * (outer + reach):
        return float(white)
    if d2 > (outer - reach) * (outer - reach) or reach > inner:
        return EDGE
    ring = (j == ring_row and (i == ring_col or i == ring_col + 2)) or (j == ring_row + 1 and i == ring_col)
    if kind == MARKED and ring and d2 < (inner + reach) * (inner + reach):
        return float(white) if d2 < (inner - reach) * (inner - reach) else EDGE
    return float(black)


@compiled
def classify(board: Vector, pattern: Vector, albedo: Image) -> None:
    """Albedo of a line of pixels where it is sure, `EDGE` where an edge is within a pixel's reach, `OUTSIDE` else."""
    kind, p, white = int(pattern[0]), pattern[3], pattern[8]
    x0, x1, y0, y1 = pattern[4], pattern[5], pattern[6], pattern[7]
    per_pitch = 1.0 / p
    for u in range(albedo.shape[0]):
        bx, by, reach = board[0, u], board[1, u], board[2, u]
        if not (bx > x0 - reach and bx < x1 + reach and by > y0 - reach and by < y1 + reach):
            albedo[u] = OUTSIDE
        elif not (bx > x0 + reach and bx < x1 - reach and by > y0 + reach and by < y1 - reach):
            albedo[u] = EDGE
        elif kind == PLAIN:
            albedo[u] = white
        elif kind == CHESS:
            a, b = math.floor(bx * per_pitch + 0.5), math.floor(by * per_pitch + 0.5)
            if abs(bx - p * a) < reach or abs(by - p * b) < reach:
                albedo[u] = EDGE
            else:
                albedo[u] = albedo_at(bx, by, pattern)
        else:
            albedo[u] = dotted(bx, by, reach, pattern)


@compiled
def disc_share(x: float, y: float, xu: float, yu: float, xv: float, yv: float, radius: float) -> float:
    """Share of a pixel inside the circle of `radius` about the origin; the pixel is the parallelogram with centre
    (x, y) and sides (xu, yu), (xv, yv). Mean of exact chords of `LINES` scan lines."""
    a = xu * xu + yu * yu
    per_a = 1.0 / a
    total = 0.0
    for line in range(LINES):
        t = (line + 0.5) / LINES - 0.5
        sx, sy = x + t * xv, y + t * yv
        b = sx * xu + sy * yu
        root = b * b - a * (sx * sx + sy * sy - radius * radius)
        if root > 0.0:
            root = math.sqrt(root)
            total += max(0.0, min(0.5, (root - b) * per_a) - max(-0.5, (-b - root) * per_a))
    return total / LINES


@compiled
def chess_share(x: float, y: float, xu: float, yu: float, xv: float, yv: float, pattern: Vector) -> float:
    """Mean albedo of a pixel of a chessboard, from `LINES` scan lines cut exactly at the squares' sides."""
    p = pattern[3]
    total = 0.0
    for line in range(LINES):
        t = (line + 0.5) / LINES - 0.5
        sx, sy = x + t * xv, y + t * yv
        first, second = 0.5, 0.5
        side = p * math.floor(sx / p + 0.5) - sx
        if abs(side) < 0.5 * abs(xu):
            first = side / xu
        side = p * math.floor(sy / p + 0.5) - sy
        if abs(side) < 0.5 * abs(yu):
            second = side / yu
        a, b = min(first, second), max(first, second)
        total += (a + 0.5) * albedo_at(sx + 0.5 * (a - 0.5) * xu, sy + 0.5 * (a - 0.5) * yu, pattern)
        total += (b - a) * albedo_at(sx + 0.5 * (a + b) * xu, sy + 0.5 * (a + b) * yu, pattern)
        total += (0.5 - b) * albedo_at(sx + 0.5 * (b + 0.5) * xu, sy + 0.5 * (b + 0.5) * yu, pattern)
    return total / LINES


@compiled
def rectangle_share(x: float, y: float, xu: float, yu: float, xv: float, yv: float, pattern: Vector) -> float:
    """Share of a pixel inside the board's bounds."""
    total = 0.0
    for line in range(LINES):
        t = (line + 0.5) / LINES - 0.5
        start, end = covered(x + t * xv, xu, pattern[4], high=pattern[5], start=-0.5, end=0.5)
        start, end = covered(y + t * yv, yu, pattern[6], high=pattern[7], start=start, end=end)
        total += max(0.0, end - start)
    return total / LINES


@compiled
def covered(x: float, dx: float, low: float, high: float, start: float, end: float) -> tuple[float, float]:
    """Clip the parameter interval (start, end) of x + s dx to low … high."""
    if dx == 0.0:
        return (start, end) if low <= x <= high else (start, start)
    a = (low - x) / dx
    b = (high - x) / dx
    return max(start, min(a, b)), min(end, max(a, b))

"""Pictures of boards by brute force: every pixel that an edge crosses is averaged over 64 rays.

Shares no code with the detection nor with the simulator: the lens is OpenCV's, the pattern is written out here from
the boards' description, so that an error in either shows. Pixel centres lie at whole numbers.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.geometry.camera import Array
from cell.measure.vision.board.view import MARKED, BoardSpec

KIND = {"marked_dots": 0, "asymmetric_dots": 1, "dots": 2, "chessboard": 3, "charuco": 4, "aprilgrid": 5}
SUB = 8
Scalars = tuple[float, ...]
Whole = tuple[int, ...]


@dataclass(frozen=True)
class Lens:
    """A camera: size in px, focal lengths and principal point in px, Brown distortion k1, k2, p1, p2, k3."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> Array:
        """Camera matrix (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in the camera frame, m."""
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Placed:
    """A board of `spec` at `pose` (4, 4), camera from board; albedos of its white and black, radius of dots in m."""

    spec: BoardSpec
    pose: Array
    white: float = 0.85
    black: float = 0.07
    margin: float = 1.0

    @property
    def radius(self) -> float:
        """Radius of a dot in m."""
        return 0.25 * self.spec.pitch if self.spec.kind == "marked_dots" else 0.3 * self.spec.pitch

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Edges x0, x1, y0, y1 of the board's sheet in the board frame in m: `margin` pitches beyond the pattern."""
        low, high = self.spec.points()[:, :2].min(axis=0), self.spec.points()[:, :2].max(axis=0)
        room = (self.margin + (1.0 if KIND[self.spec.kind] >= 3 else 0.0)) * self.spec.pitch
        return (low[0] - room, high[0] + room, low[1] - room, high[1] + room)


def true_pixels(lens: Lens, placed: Placed) -> Array:
    """Where each point (n, 2) of the board is seen: corners projected, dots as the middle of their outline's area."""
    points = placed.spec.points()
    if KIND[placed.spec.kind] >= 3:
        return lens.project(points @ placed.pose[:3, :3].T + placed.pose[:3, 3])
    angle = np.arange(90) * 2 * np.pi / 90
    circle = placed.radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(90)])
    outline = (points[:, None, :] + circle).reshape(-1, 3) @ placed.pose[:3, :3].T + placed.pose[:3, 3]
    x, y = np.moveaxis(lens.project(outline).reshape(-1, 90, 2), 2, 0)
    middle_x, middle_y = x.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    x, y = x - middle_x, y - middle_y
    xn, yn = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    cross = x * yn - xn * y
    area = 3 * cross.sum(axis=1)
    cu, cv = ((x + xn) * cross).sum(axis=1) / area, ((y + yn) * cross).sum(axis=1) / area
    return np.column_stack([cu + middle_x[:, 0], cv + middle_y[:, 0]])


def paint(image: NDArray[np.float32], lens: Lens, placed: Placed) -> None:
    """Lay the board's albedo over `image` (h, w), hard-edged but for the averaging within pixels."""
    x0, x1, y0, y1 = placed.bounds
    corners = np.array([[x, y, 0.0] for x in (x0, 0.5 * (x0 + x1), x1) for y in (y0, 0.5 * (y0 + y1), y1)])
    pixels = lens.project(corners @ placed.pose[:3, :3].T + placed.pose[:3, 3])
    room = 0.08 * np.ptp(pixels, axis=0) + 3
    low = np.clip(np.floor(pixels.min(axis=0) - room), 0, (lens.width, lens.height)).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0) + room), 0, (lens.width, lens.height)).astype(int)
    if (low >= high).any():
        return
    spec = placed.spec
    inverse = np.linalg.inv(np.column_stack([placed.pose[:3, 0], placed.pose[:3, 1], placed.pose[:3, 3]]))
    # Tuples: references to arrays are counted at each call, which took most of the time.
    shape = (KIND[spec.kind], spec.cols, spec.rows)
    size = tuple(map(float, (spec.pitch, placed.radius, spec.marker, x0, x1, y0, y1, placed.white, placed.black)))
    turn = tuple(inverse.ravel().tolist())
    _paint(image, *_rays(lens), turn, tuple(map(int, (*low, *high))), shape, size, _markers(spec))


@lru_cache(maxsize=8)
def _rays(lens: Lens) -> tuple[Array, Array]:
    """Normalised coordinates x and y (h, w) of the pixels' middles."""
    u, v = np.meshgrid(np.arange(lens.width, dtype=np.float64), np.arange(lens.height, dtype=np.float64))
    grid = np.column_stack([u.ravel(), v.ravel()]).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-10)
    ideal = cv2.undistortPointsIter(grid, lens.matrix, np.array(lens.distortion), np.eye(3), np.eye(3), stop)
    flat = np.asarray(ideal, dtype=np.float64).reshape(lens.height, lens.width, 2)
    return np.ascontiguousarray(flat[..., 0]), np.ascontiguousarray(flat[..., 1])


@lru_cache(maxsize=64)
def _markers(spec: BoardSpec) -> NDArray[np.uint8]:
    """Cells (n, m, m) of the markers of a ChArUco board or of a grid of tags with their black rim, 1 for white."""
    if spec.kind not in MARKED:
        return np.zeros((1, 1, 1), dtype=np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    cells = dictionary.markerSize + 2
    count = spec.cols * spec.rows // (2 if spec.kind == "charuco" else 1)
    return np.array([cv2.aruco.generateImageMarker(dictionary, k, cells) // 255 for k in range(count)], dtype=np.uint8)


@compiled
def _tags(
    x: float, y: float, cols: int, rows: int, side: float, markers: NDArray[np.uint8]
) -> bool:  # pragma: no cover
    """True where a grid of tags is white: tags numbered from the last row up, black squares where the gaps meet."""
    i, j = int(np.floor(x)), int(np.floor(y))
    a, b = x - i, y - j
    if a >= side and b >= side:
        return not (-1 <= i < cols and -1 <= j < rows)
    if a >= side or b >= side or i < 0 or j < 0 or i >= cols or j >= rows:
        return True
    cells = markers.shape[1]
    return bool(markers[(rows - 1 - j) * cols + i, int(b / side * cells), int(a / side * cells)])


@compiled
def _shade(x: float, y: float, shape: Whole, size: Scalars, markers: NDArray[np.uint8]) -> float:  # pragma: no cover
    """Albedo at a place of the board; −1 beside the sheet."""
    pitch, radius, marker, white, black = size[0], size[1], size[2], size[7], size[8]
    if x < size[3] or x > size[4] or y < size[5] or y > size[6]:
        return -1.0
    kind, cols, rows = shape[0], shape[1], shape[2]
    if kind == 5:
        return float(white if _tags(x / pitch, y / pitch, cols, rows, marker / pitch, markers) else black)
    if kind >= 3:
        i, j = int(np.floor(x / pitch)) + 1, int(np.floor(y / pitch)) + 1
        across = cols if kind == 4 else cols + 1
        down = rows if kind == 4 else rows + 1
        if i < 0 or j < 0 or i >= across or j >= down:
            return float(white)
        if (i + j) % 2 == 0:
            return float(black)
        if kind == 3:
            return float(white)
        rim = 0.5 * (pitch - marker)
        a, b = x - (i - 1) * pitch - rim, y - (j - 1) * pitch - rim
        if a < 0 or b < 0 or a >= marker or b >= marker:
            return float(white)
        number = (j * across) // 2 + i // 2
        cells = markers.shape[1]
        bit = markers[number, int(b / marker * cells), int(a / marker * cells)]
        return float(white if bit else black)
    j = int(np.round(y / pitch))
    if kind == 1:
        odd = j % 2
        i = int(np.round((x / pitch - odd) / 2))
        dx, dy = x - (2 * i + odd) * pitch, y - j * pitch
    else:
        i = int(np.round(x / pitch))
        dx, dy = x - i * pitch, y - j * pitch
    if i < 0 or j < 0 or i >= cols or j >= rows:
        return float(white)
    r2 = dx * dx + dy * dy
    if r2 > radius * radius:
        return float(white)
    if kind == 0:
        c, r = (cols - 1) // 2, (rows - 1) // 2
        ring = (i == c and j == r) or (i == c + 2 and j == r) or (i == c and j == r + 1)
        if ring and r2 < 0.25 * radius * radius:
            return float(white)
    return float(black)


@compiled
def _seen(
    x: float, y: float, inverse: Scalars, shape: Whole, size: Scalars, markers: NDArray[np.uint8]
) -> float:  # pragma: no cover
    """Albedo that a ray through the ideal coordinates x, y meets; −1 beside the sheet."""
    w = inverse[6] * x + inverse[7] * y + inverse[8]
    if w <= 0:
        return -1.0
    bx = (inverse[0] * x + inverse[1] * y + inverse[2]) / w
    by = (inverse[3] * x + inverse[4] * y + inverse[5]) / w
    return float(_shade(bx, by, shape, size, markers))


@compiled
def _paint(
    image: NDArray[np.float32], ray_x: Array, ray_y: Array, inverse: Scalars, window: Whole, shape: Whole,
    size: Scalars, markers: NDArray[np.uint8],
) -> None:  # pragma: no cover  # fmt: skip
    height, width = image.shape
    first, count = window[0], window[2] - window[0]
    # What is seen at the middles of the pixels, of their sides and at their corners: in rows half a pixel apart.
    above, amid, below = np.empty(2 * count + 1), np.empty(2 * count + 1), np.empty(2 * count + 1)
    slopes = np.empty((count, 4))
    for v in range(window[1], window[3]):
        up, down = max(v - 1, 0), min(v + 1, height - 1)
        above, below = below, above
        for n in range(count):
            u = first + n
            left, right = max(u - 1, 0), min(u + 1, width - 1)
            slopes[n, 0] = xu = (ray_x[v, right] - ray_x[v, left]) / (right - left)
            slopes[n, 1] = yu = (ray_y[v, right] - ray_y[v, left]) / (right - left)
            slopes[n, 2] = xv = (ray_x[down, u] - ray_x[up, u]) / (down - up)
            slopes[n, 3] = yv = (ray_y[down, u] - ray_y[up, u]) / (down - up)
            for k in range(0 if n == 0 else 1, 3):
                a = 0.5 * (k - 1)
                x, y = ray_x[v, u] + a * xu, ray_y[v, u] + a * yu
                amid[2 * n + k] = _seen(x, y, inverse, shape, size, markers)
                below[2 * n + k] = _seen(x + 0.5 * xv, y + 0.5 * yv, inverse, shape, size, markers)
                if v == window[1]:
                    above[2 * n + k] = _seen(x - 0.5 * xv, y - 0.5 * yv, inverse, shape, size, markers)
        for n in range(count):
            u, value, mixed = first + n, amid[2 * n + 1], False
            for k in range(2 * n, 2 * n + 3):
                mixed = mixed or above[k] != value or amid[k] != value or below[k] != value
            if not mixed:
                if value >= 0:
                    image[v, u] = value
                continue
            xu, yu, xv, yv = slopes[n]
            total = 0.0
            for k in range(SUB * SUB):
                a, b = (k % SUB + 0.5) / SUB - 0.5, (k // SUB + 0.5) / SUB - 0.5
                x, y = ray_x[v, u] + a * xu + b * xv, ray_y[v, u] + a * yu + b * yv
                value = _seen(x, y, inverse, shape, size, markers)
                total += image[v, u] if value < 0 else value
            image[v, u] = total / (SUB * SUB)

"""The placement surfaces as height fields z = h(x, y) in the surface frame S, and as meshes.

`pot` is a free-form relief without symmetry, `seat` a curved seat with a ledge, a step and a recess whose flanks are
steep but finite; both cover |x| ≤ 35 mm, |y| ≤ 18 mm. `panel` is a curved sheet with three beads, |y| ≤ 30 mm: wider
than the scan camera's field. Around them lies the table, z = 0. Of a mesh file the ground is the highest that the mesh
is above each place, from a raster fine enough that what lies between its points is less than what a part can feel.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled

Floats = NDArray[np.float64]

HALF_X = 0.035
"""Half the pot's footprint along x_S, the sweep direction, m."""
HALF_Y = 0.018
"""Half the pot's footprint along y_S, the direction of the stripe, m."""


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles of a surface: vertices (n, 3), m, frame S; triangles (m, 3), counter-clockwise from outside."""

    vertices: Floats
    triangles: NDArray[np.int32]


@dataclass(frozen=True)
class Surface:
    """A height field over the footprint of half the sides `half_x`, `half_y` about `centre`, m, up to `top`, m.

    `relief(x, y)` gives height, ∂h/∂x and ∂h/∂y in m and m/m, nan where there is nothing. Around it and in its holes
    lies the `table`, z = a + b x + c y.
    """

    name: str
    relief: Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]
    half_x: float = HALF_X
    half_y: float = HALF_Y
    centre: tuple[float, float] = (0.0, 0.0)
    top: float = 0.015
    table: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def sample(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Heights (n,), m, and upward unit normals (n, 3) at x, y (n,) in S; outside the footprint the table's."""
        relief = self.relief(x, y)
        inside = (np.abs(x - self.centre[0]) <= self.half_x) & (np.abs(y - self.centre[1]) <= self.half_y)
        inside &= np.isfinite(relief[0])
        a, b, c = self.table
        h = np.where(inside, relief[0], a + b * x + c * y)
        gx, gy = np.where(inside, relief[1], b), np.where(inside, relief[2], c)
        steepness = np.sqrt(1.0 + gx * gx + gy * gy)
        return h, np.stack([-gx / steepness, -gy / steepness, 1.0 / steepness], axis=-1)

    def height(self, x: Floats, y: Floats) -> Floats:
        """Height (n,), m, of the surface at x, y (n,) in S; outside the footprint that of the table, 0."""
        return self.sample(x, y)[0]


def wave(x: Floats, y: Floats, waviness: tuple[float, float, float]) -> tuple[Floats, Floats, Floats]:
    """Height, m, and slopes along x and y of a sine: amplitude and wavelength, m, and direction from x, rad."""
    amplitude, wavelength, direction = waviness
    kx, ky = (2.0 * np.pi / wavelength if amplitude else 0.0) * np.array([np.cos(direction), np.sin(direction)])
    rise = amplitude * np.cos(kx * x + ky * y)
    return amplitude * np.sin(kx * x + ky * y), rise * kx, rise * ky


def waved(plain: Surface, waviness: tuple[float, float, float]) -> Surface:
    """The height field with a sine on it, see `wave`."""

    def relief(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        (h, gx, gy), (rise, by_x, by_y) = plain.relief(x, y), wave(x, y, waviness)
        return h + rise, gx + by_x, gy + by_y

    return replace(plain, relief=relief, top=plain.top + waviness[0])


# Wave vectors (rad/m), phases (rad) and amplitudes (m) of the pot's relief; no two vectors are parallel, so that no
# slide or turn of the surface maps it onto itself.
_WAVES = np.array(
    [
        [150.0, 70.0, 0.40, 0.0014],
        [-90.0, 230.0, 1.30, 0.0011],
        [240.0, -110.0, 2.50, 0.0008],
        [60.0, 310.0, 4.10, 0.0006],
    ]
)
_POT_FLOOR = 0.0055


def _pot(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    kx, ky, phase, amplitude = _WAVES.T
    angle = np.multiply.outer(x, kx) + np.multiply.outer(y, ky) + phase
    rise = amplitude * np.cos(angle)
    return _POT_FLOOR + (amplitude * np.sin(angle)).sum(-1), (rise * kx).sum(-1), (rise * ky).sum(-1)


_FLANK = 0.0008


def _step(along: Floats, rise: float) -> tuple[Floats, Floats]:
    """A rise of `rise` m where `along` (m, signed distance) passes zero, with its slope."""
    s = np.tanh(along / _FLANK)
    return 0.5 * rise * (1.0 + s), 0.5 * rise * (1.0 - s * s) / _FLANK


def _seat(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    h = 0.0045 + 3.0 * x * x + 6.0 * y * y + 0.05 * x - 0.03 * y + 2.0 * x * y
    gx = 6.0 * x + 0.05 + 2.0 * y
    gy = 12.0 * y - 0.03 + 2.0 * x
    for nx, ny, offset, rise in ((0.970, -0.243, 0.013, 0.0026), (-0.148, 0.989, 0.006, -0.0022)):
        up, slope = _step(nx * x + ny * y - offset, rise)
        h, gx, gy = h + up, gx + slope * nx, gy + slope * ny
    dx, dy = x + 0.016, y + 0.006
    radius = np.sqrt(dx * dx + dy * dy + 1e-12)
    up, slope = _step(radius - 0.007, 0.0020)
    return h + up - 0.0020, gx + slope * dx / radius, gy + slope * dy / radius


# Normal (x, y), offset (m), rise (m) and width (m) of the panel's beads; no two run in parallel.
_BEADS = (
    (0.940, 0.342, -0.011, 0.0030, 0.0050),
    (-0.270, 0.963, 0.007, 0.0024, 0.0045),
    (0.620, -0.785, 0.019, 0.0026, 0.0055),
)


def _panel(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    h = 0.0035 + 1.8 * x * x + 2.4 * y * y + 1.2 * x * y + 0.02 * x - 0.015 * y
    gx = 3.6 * x + 1.2 * y + 0.02
    gy = 4.8 * y + 1.2 * x - 0.015
    for nx, ny, offset, rise, width in _BEADS:
        along = (nx * x + ny * y - offset) / width
        s = np.tanh(along)
        up = rise * (1.0 - s * s)
        slope = -2.0 * up * s / width
        h, gx, gy = h + up, gx + slope * nx, gy + slope * ny
    return h, gx, gy


SURFACES = {
    made.name: made for made in (Surface("pot", _pot), Surface("seat", _seat), Surface("panel", _panel, half_y=0.030))
}


def surface(name: str) -> Surface:
    """The surface called `name`. Raises ValueError that lists the names."""
    if name not in SURFACES:
        raise ValueError(f"unknown surface {name!r}: choose one of {', '.join(sorted(SURFACES))}")
    return SURFACES[name]


@cache
def mesh(name: str, triangles: int = 80_000, walls: bool = True) -> SurfaceMesh:
    """A regular grid mesh of the surface `name` with about `triangles` triangles, in S. `walls` adds the sides from the
    border down to the table, as seen by a camera. Raises ValueError for an unknown name or fewer than 100 triangles."""
    field = surface(name)
    if triangles < 100:
        raise ValueError(f"a surface mesh of {triangles} triangles is too coarse: ask for 100 or more")
    half_x, half_y = field.half_x, field.half_y
    cell = np.sqrt(8.0 * half_x * half_y / triangles)
    nx, ny = (max(2, round(2.0 * half / cell) + 1) for half in (half_x, half_y))
    x, y = np.meshgrid(np.linspace(-half_x, half_x, nx), np.linspace(-half_y, half_y, ny), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), field.height(x.ravel(), y.ravel())], axis=-1)
    index = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    if walls:
        vertices, faces = _add_walls(vertices, faces, index)
    return SurfaceMesh(vertices, faces.astype(np.int32))


def _add_walls(vertices: Floats, faces: NDArray[np.intp], index: NDArray[np.intp]) -> tuple[Floats, NDArray[np.intp]]:
    border = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    foot = vertices[border] * [1.0, 1.0, 0.0]
    below = len(vertices) + np.arange(len(border))
    upper, lower = np.roll(border, -1), np.roll(below, -1)
    sides = np.concatenate([np.stack([border, below, lower], -1), np.stack([border, lower, upper], -1)])
    return np.concatenate([vertices, foot]), np.concatenate([faces, sides])


Faces = NDArray[np.int64]

FINEST, MOST_POINTS = 1e-4, 1200
"""Raster of the height field: its step, m, at least, and points along the longer side at most."""
COARSEST, COARSEST_PART = 1e-3, 4e-3
"""Triangles are divided until no side is longer, m, or than a hundredth of the mesh: ambient light is drawn by them. It
is drawn more coarsely on a part, which is in most pictures."""
UNITS = {"m": 1.0, "mm": 1e-3}


@dataclass(frozen=True, eq=False)
class OwnSurface:
    """`ground` is the height field, `vertices` (n, 3) m and `triangles` (m, 3) the mesh without sides, frame S."""

    ground: Surface
    vertices: Floats
    triangles: Faces

    def walled(self, table: tuple[float, float, float]) -> SurfaceMesh:
        """The mesh with sides from its open borders down to the table, z = a + b x + c y in S."""
        edges = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        single, count = np.unique(edges, axis=0, return_counts=True)
        border = single[count == 1]
        vertices, faces = self.vertices, self.triangles
        if len(border):
            a, b, c = table
            rim = np.unique(border)
            feet = vertices[rim].copy()
            feet[:, 2] = np.minimum(feet[:, 2], a + b * feet[:, 0] + c * feet[:, 1])
            below = np.searchsorted(rim, border) + len(vertices)
            first, second = border.T
            sides = [np.stack([first, below[:, 0], below[:, 1]], -1), np.stack([first, below[:, 1], second], -1)]
            vertices, faces = np.concatenate([vertices, feet]), np.concatenate([faces, *sides])
        return SurfaceMesh(vertices, faces.astype(np.int32))


@dataclass(frozen=True)
class _ReadMesh:
    """A mesh file: two that say the same by the same name are one, wherever they lie."""

    path: str = field(compare=False)
    unit: str
    name: str
    content: bytes

    @classmethod
    def at(cls, path: str, unit: str) -> Self:
        """The file as it is now. Raises ValueError where it cannot be read."""
        try:
            return cls(path, unit, Path(path).name, sha256(Path(path).read_bytes()).digest())
        except OSError as error:
            raise ValueError(f"the mesh {path} cannot be read: {error.strerror}") from error


def own_surface(path: str, unit: str) -> OwnSurface:
    """The surface in a mesh file; the last few are kept. Raises ValueError when there is no mesh in it."""
    return _read(_ReadMesh.at(path, unit))


def part_mesh(path: str, unit: str) -> SurfaceMesh:
    """The part in a mesh file as a camera above it sees it: walls are as drawn, they only hide what is behind them."""
    return _part(_ReadMesh.at(path, unit))


def underside(path: str, unit: str) -> Surface:
    """The lowest that the part in a mesh file has above each place of its frame, as heights turned over: z = -h."""
    return _turned_over(own_surface(path, unit))


@lru_cache(maxsize=4)
def _read(file: _ReadMesh) -> OwnSurface:
    import trimesh

    merged = trimesh.Trimesh(*_divided(*_loaded(file), COARSEST), process=True)
    vertices, faces = np.asarray(merged.vertices, dtype=np.float64), np.asarray(merged.faces, dtype=np.int64)
    return OwnSurface(_ground(Path(file.name).stem, vertices, faces), vertices, faces)


@lru_cache(maxsize=4)
def _part(file: _ReadMesh) -> SurfaceMesh:
    vertices, faces = _loaded(file)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    up = np.cross(b - a, c - a)[:, 2] > 0.0
    if not up.any():
        return SurfaceMesh(vertices, faces.astype(np.int32))
    above, shown = _divided(vertices, faces[up], COARSEST_PART)
    return SurfaceMesh(
        np.concatenate([above, vertices]), np.concatenate([shown, faces[~up] + len(above)]).astype(np.int32)
    )


@lru_cache(maxsize=4)
def _turned_over(own: OwnSurface) -> Surface:
    return _ground(own.ground.name, own.vertices * [1.0, 1.0, -1.0], own.triangles)


def _loaded(file: _ReadMesh) -> tuple[Floats, Faces]:
    """Vertices (n, 3), m, and triangles (m, 3) of a mesh file."""
    import trimesh

    try:
        mesh = trimesh.load_mesh(file.path, process=True)
        vertices = UNITS[file.unit] * np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int64)
        if not len(faces) or not np.isfinite(vertices).all():
            raise ValueError(f"{len(faces)} triangles, or corners that are not numbers")
    except Exception as error:  # every reader of trimesh raises its own
        raise ValueError(f"the mesh {file.path} cannot be read: {error}") from error
    return vertices, faces


def _divided(vertices: Floats, faces: Faces, coarsest: float) -> tuple[Floats, Faces]:
    """The same with no side longer than `coarsest`, m, or a hundredth of the mesh."""
    from trimesh.remesh import subdivide_to_size

    longest = max(coarsest, float(np.ptp(vertices, axis=0).max()) / 100.0)
    divide: Any = subdivide_to_size
    made: tuple[Floats, Faces] = divide(vertices, faces, longest, max_iter=20)
    return made


def _ground(name: str, vertices: Floats, faces: Faces) -> Surface:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = max(FINEST, float((high - low)[:2].max()) / MOST_POINTS)
    nx, ny = (int(np.ceil(side / step)) + 1 for side in (high - low)[:2])
    heights = np.full((nx, ny), np.nan)
    raster(vertices[faces], low[:2].copy(), step, heights)

    def relief(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        u, v = (np.asarray(x) - low[0]) / step, (np.asarray(y) - low[1]) / step
        i = np.clip(np.floor(np.nan_to_num(u)), 0, nx - 2).astype(np.intp)
        j = np.clip(np.floor(np.nan_to_num(v)), 0, ny - 2).astype(np.intp)
        a, b = u - i, v - j
        h00, h10, h01, h11 = heights[i, j], heights[i + 1, j], heights[i, j + 1], heights[i + 1, j + 1]
        h = (1 - a) * ((1 - b) * h00 + b * h01) + a * ((1 - b) * h10 + b * h11)
        gx = ((1 - b) * (h10 - h00) + b * (h11 - h01)) / step
        gy = ((1 - a) * (h01 - h00) + a * (h11 - h10)) / step
        return h, gx, gy

    half, centre = 0.5 * (high - low), 0.5 * (high + low)
    return Surface(
        name, relief, float(half[0]), float(half[1]), centre=(float(centre[0]), float(centre[1])), top=float(high[2])
    )  # fmt: skip


@compiled
def raster(corners: Floats, low: Floats, step: float, heights: Floats) -> None:
    """Fill `heights` (nx, ny) with the highest z of the triangles (n, 3, 3) at low + step (i, j)."""
    for t in range(corners.shape[0]):
        ax, ay, az = corners[t, 0, 0] - low[0], corners[t, 0, 1] - low[1], corners[t, 0, 2]
        bx, by, bz = corners[t, 1, 0] - low[0], corners[t, 1, 1] - low[1], corners[t, 1, 2]
        cx, cy, cz = corners[t, 2, 0] - low[0], corners[t, 2, 1] - low[1], corners[t, 2, 2]
        double_area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(double_area) < 1e-18:
            continue
        first_i = max(int(np.ceil(min(ax, bx, cx) / step - 1e-6)), 0)
        last_i = min(int(np.floor(max(ax, bx, cx) / step + 1e-6)), heights.shape[0] - 1)
        first_j = max(int(np.ceil(min(ay, by, cy) / step - 1e-6)), 0)
        last_j = min(int(np.floor(max(ay, by, cy) / step + 1e-6)), heights.shape[1] - 1)
        for i in range(first_i, last_i + 1):
            for j in range(first_j, last_j + 1):
                x, y = i * step, j * step
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / double_area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / double_area
                wc = 1.0 - wa - wb
                if wa < -1e-6 or wb < -1e-6 or wc < -1e-6:
                    continue
                z = wa * az + wb * bz + wc * cz
                if not heights[i, j] >= z:
                    heights[i, j] = z

"""The placement surfaces: closed-form height fields z = h(x, y) in the surface frame S, and meshes of them.

`pot` is a free-form relief without symmetry, `seat` a curved seat with a ledge, a step and a recess whose flanks are
steep but finite; both cover |x| ≤ 35 mm, |y| ≤ 18 mm. `panel` is a curved sheet with three beads, |y| ≤ 30 mm: wider
than the scan camera's field. Around them lies the table, z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

HALF_X = 0.035
"""Half the pot's footprint along x_S, the sweep direction, m."""
HALF_Y = 0.018
"""Half the pot's footprint along y_S, the direction of the stripe, m."""


@dataclass(frozen=True)
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
    """A regular grid mesh of the surface `name` with about `triangles` triangles, in S.

    `walls` adds the sides from the border down to the table, as seen by a camera. Raises ValueError for an unknown
    name or fewer than 100 triangles.
    """
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

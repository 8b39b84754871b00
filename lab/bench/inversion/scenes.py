"""The parts of the inversion campaigns, and clouds of them on a table as a sweep gives them, at a known pose.

A part's height is a closed form, its mesh and the noise of its clouds are made from it here: neither the simulator nor
the estimator has a say in what is true. Clouds have noise, outliers, foreign objects and missing data.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.nominal import Array
from cell.measure.reconstruction.cloud import Cloud

Height = Callable[[Array, Array], Array]
Symmetry = Literal["none", "axis", "centre"]

HALF_X, HALF_Y = 0.035, 0.018
"""Half the footprint of the rectangular parts, m."""
DISC = 0.021
"""Radius of the footprint of the round parts, m."""
SPHERE = 0.040
"""Radius of the sphere cap, m; its centre lies at z = −32 mm."""
HOLES = ((-0.016, 0.004), (0.018, -0.005))
"""Centres of the two countersunk holes, m; bore and countersink radii are `BORE` and `SINK`."""
BORE, SINK = 0.0030, 0.0055


@dataclass(frozen=True)
class Part:
    """A part: `height(x, y)` in m, NaN where there is none. symmetry: "axis" turns about its z axis, "centre" about
    `centre` (m, surface frame) onto itself."""

    name: str
    title: str
    height: Height
    symmetry: Symmetry = "none"
    round: bool = False
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def inside(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """True where (x, y) lies on the footprint."""
        if self.round:
            return np.asarray(np.hypot(x, y) < DISC)
        return np.asarray((np.abs(x) < HALF_X) & (np.abs(y) < HALF_Y))

    def error(self, found: pin.SE3, true: pin.SE3) -> tuple[float, float]:
        """Error of a pose in m and rad, of what the surface determines: its free motions do not count."""
        if self.symmetry == "centre":
            centre = np.array(self.centre)
            return float(np.linalg.norm(found.act(centre) - true.act(centre))), 0.0
        off = difference(found, true)
        if self.symmetry == "axis":
            cosine = float(np.clip(found.rotation[:, 2] @ true.rotation[:, 2], -1.0, 1.0))
            return float(np.linalg.norm(off[:3])), float(np.arccos(cosine))
        return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))


def _pot(x: Array, y: Array) -> Array:
    waves = 0.0015 * np.sin(150 * x + 70 * y + 0.4) + 0.0011 * np.sin(230 * y - 90 * x + 1.3)
    return np.asarray(0.006 + waves + 0.0006 * np.sin(60 * x + 310 * y + 4.1) + 4 * x * y)


def _turned(x: Array, y: Array) -> Array:
    r = np.hypot(x, y)
    return np.asarray(0.003 + 6 * r**2 + 0.001 * np.cos(300 * r))


def _seat(x: Array, y: Array) -> Array:
    step = np.clip((0.97 * x - 0.243 * y - 0.013) / 0.0004, -1.0, 1.0)
    ledge = np.clip((0.989 * y - 0.148 * x - 0.006) / 0.0004, -1.0, 1.0)
    return np.asarray(0.0058 + 3 * x**2 + 6 * y**2 + 0.05 * x - 0.03 * y + 2 * x * y + 0.0013 * step - 0.0011 * ledge)


def _plate(x: Array, y: Array) -> Array:
    z = np.full_like(x, 0.004)
    for cx, cy in HOLES:
        r = np.hypot(x - cx, y - cy)
        z = np.where(r < SINK, 0.004 - (SINK - r), z)
        z = np.where(r < BORE, np.nan, z)
    return np.asarray(z)


def _cap(x: Array, y: Array) -> Array:
    return np.asarray(SPHERE * np.sqrt(np.maximum(1.0 - (x**2 + y**2) / SPHERE**2, 0.0)) - 0.032)


PARTS = {
    part.name: part
    for part in (
        Part("pot", "free-form pot", _pot),
        Part("turned", "pot of revolution", _turned, "axis", round=True),
        Part("seat", "curved seat with edges", _seat),
        Part("plate", "plane with two holes", _plate),
        Part("cap", "sphere cap", _cap, "centre", True, (0.0, 0.0, -0.032)),
    )
}


@cache
def nominal(name: str, step: float = 0.0005) -> NominalSurface:
    """The nominal mesh of the part `name`, corners about `step` m apart, on the edges of the closed form where it has
    any."""
    part = PARTS[name]
    if part.round:
        x, y = _rings(0.0, 0.0, np.linspace(0.0, DISC, int(DISC / step) + 1), step)
    else:
        nx, ny = int(2 * HALF_X / step) + 1, int(2 * HALF_Y / step) + 1
        x, y = np.meshgrid(np.linspace(-HALF_X, HALF_X, nx), np.linspace(-HALF_Y, HALF_Y, ny), indexing="ij")
        x, y = x.ravel(), y.ravel()
    if name == "plate":
        for cx, cy in HOLES:
            away = np.hypot(x - cx, y - cy) > SINK + 0.4 * step
            ring = _rings(cx, cy, np.linspace(BORE, SINK, 6), step)
            x, y = np.append(x[away], ring[0]), np.append(y[away], ring[1])
    corners = np.column_stack([x, y])
    triangles = Delaunay(corners).simplices
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles = np.where(area[:, None] < 0, triangles[:, ::-1], triangles)[np.abs(area) > 1e-12]
    middle = corners[triangles].mean(axis=1)
    if name == "plate":
        triangles = triangles[[all(np.hypot(m[0] - u, m[1] - v) > BORE for u, v in HOLES) for m in middle]]
        # The corners on a bore lie at its closed-form height: a hair outside of it, where the height exists.
        x, y = _off_the_bores(x, y)
    return NominalSurface(np.column_stack([x, y, part.height(x, y)]), triangles)


def _off_the_bores(x: Array, y: Array) -> tuple[Array, Array]:
    for cx, cy in HOLES:
        r = np.hypot(x - cx, y - cy)
        grow = np.where(r < BORE * 1.0001, BORE * 1.000001 / np.maximum(r, 1e-9), 1.0)
        x, y = cx + (x - cx) * grow, cy + (y - cy) * grow
    return x, y


def _rings(cx: float, cy: float, radii: Array, step: float) -> tuple[Array, Array]:
    x, y = [], []
    for k, radius in enumerate(radii):
        count = max(1, int(np.ceil(2 * np.pi * radius / step)))
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (k % 2)) / count
        x.append(cx + radius * np.cos(angle))
        y.append(cy + radius * np.sin(angle))
    return np.concatenate(x), np.concatenate(y)


Mask = NDArray[np.bool_]

STRIPE_SIGMA, RAIL_SIGMA = 40e-6, 8e-6
"""Standard deviations of the drawn noise, m: of a point by its stripe centre, and of a line by the rail."""
TRUE = pin.SE3(pin.exp3(np.array([0.01, -0.02, 0.03])), np.array([0.75, 0.01, 0.05]))
"""base_from_surface of every scene, before `Scene.moved`."""
LINES, ROWS = 200, 200
WILD = 0.01
"""Share of points that lie anywhere."""


@dataclass(frozen=True)
class Setting:
    """What is wrong with a scan: shares of the part's points that are clutter or missing."""

    clutter: float = 0.0
    missing: float = 0.0


SETTINGS = {
    "clean": Setting(),
    "40 % missing": Setting(missing=0.4),
    "20 % clutter": Setting(clutter=0.2),
    "both": Setting(clutter=0.2, missing=0.4),
}


def scan(
    part: Part, rng: np.random.Generator, setting: Setting | None = None, *,
    height: Callable[[Array, Array], Array] | None = None,
) -> Cloud:  # fmt: skip
    """A cloud of `part` and the table around it, arm base; `height` is another surface that lies in its place."""
    setting = setting or Setting()
    reach_x, reach_y = (0.024, 0.024) if part.round else (0.038, 0.021)
    shift = rng.uniform(-0.0015, 0.0015, 2)
    x, y = np.meshgrid(
        np.linspace(-reach_x, reach_x, LINES) + shift[0], np.linspace(-reach_y, reach_y, ROWS) + shift[1], indexing="ij"
    )
    inside = part.inside(x, y)
    z = np.where(inside, (height or part.height)(x, y), 0.0)
    if setting.clutter:
        z = _cluttered(x, y, z, inside, setting.clutter, rng)
    if setting.missing:
        z = np.where(_hidden(x, y, inside, setting.missing, rng), np.nan, z)
    points = np.stack([x, y, z], -1)
    across = np.array([0.06, 0.0, 1.0]) * STRIPE_SIGMA
    points += across * rng.standard_normal((LINES, ROWS, 1))
    points[:, :, 0] += RAIL_SIGMA * rng.standard_normal((LINES, 1))
    wild = rng.random((LINES, ROWS)) < WILD
    points[wild, 2] += rng.uniform(-0.004, 0.004, int(wild.sum()))
    points[~np.isfinite(z)] = np.nan
    return Cloud(
        points=points @ TRUE.rotation.T + TRUE.translation,
        stripe_spread=np.broadcast_to(across @ TRUE.rotation.T, points.shape).astype(np.float32),
        rail_spread=np.tile(TRUE.rotation[:, 0] * RAIL_SIGMA, (LINES, 1)), centres=np.zeros((LINES, ROWS)),
        rail=np.linspace(0.0, 2 * reach_x, LINES), rejected=np.zeros((LINES, ROWS), dtype=bool),
    )  # fmt: skip


def _cluttered(x: Array, y: Array, z: Array, inside: Mask, share: float, rng: np.random.Generator) -> Array:
    """Foreign objects on the part, chips and washers 0.15 to 6 mm high, until they hide `share` of its points."""
    places = np.argwhere(inside)
    hidden = np.zeros_like(inside)
    while hidden.sum() < share * inside.sum():
        i, j = places[rng.integers(len(places))]
        turn, long, short = rng.uniform(0, np.pi), rng.uniform(0.002, 0.006), rng.uniform(0.001, 0.004)
        u = (x - x[i, j]) * np.cos(turn) + (y - y[i, j]) * np.sin(turn)
        v = (y - y[i, j]) * np.cos(turn) - (x - x[i, j]) * np.sin(turn)
        under = inside & ((np.abs(u) < long) & (np.abs(v) < short) if rng.random() < 0.5 else u**2 + v**2 < short**2)
        top = np.nanmax(np.where(under, z, -np.inf)) + np.exp(rng.uniform(np.log(0.00015), np.log(0.006)))
        lying = rng.random() < 0.5
        z = np.where(under, top if lying else z + (top - z[i, j] if np.isfinite(z[i, j]) else 0.001), z)
        hidden |= under
    return z


def _hidden(x: Array, y: Array, inside: Mask, share: float, rng: np.random.Generator) -> Mask:
    """Where nothing was seen: one side of the part, then patches, until `share` of its points are missing."""
    direction = rng.uniform(0, 2 * np.pi)
    along = np.cos(direction) * x / np.ptp(x) + np.sin(direction) * y / np.ptp(y)
    hidden = along > np.quantile(along[inside], 1 - 0.5 * share)
    places = np.argwhere(inside)
    while (hidden & inside).sum() < share * inside.sum():
        i, j = places[rng.integers(len(places))]
        hidden |= np.hypot(x - x[i, j], y - y[i, j]) < rng.uniform(0.002, 0.006)
    return np.asarray(hidden)


def start_away(rng: np.random.Generator, metres: float, degrees: float) -> pin.SE3:
    """A pose `metres` and `degrees` away from `TRUE`, in random directions."""
    way, axis = rng.normal(size=3), rng.normal(size=3)
    turn = np.radians(degrees) * axis / np.linalg.norm(axis)
    return perturbed(TRUE, np.concatenate([metres * way / np.linalg.norm(way), turn]))

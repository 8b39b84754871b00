"""The nominal surface of a job: a triangle mesh, the closest point on it, its normals, and a scan's points beside it.

Closest points are found on the triangles themselves, so that the distance is exact to the tessellation: a grid of cells
knows a triangle near each, from which a walk leads over the mesh. A look-up and a few triangles replace a tree search
for every point; the grid also serves as a coarse distance field. Points whose foot lies on the rim say nothing about
the surface.
"""

from copy import copy
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import ArrayLike, NDArray

from cell.base.compiled import compiled
from cell.measure.geometry.poses import cross
from cell.measure.reconstruction.cloud import Cloud
from drivers.errors import ConfigError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Point = tuple[float, float, float]

CELL = 0.0005
"""Edge of a cell, m, unless that makes more than `MOST_CELLS`."""
MOST_CELLS = 1_000_000
MARGIN = 0.004
"""How far the grid reaches beyond the mesh, m; points outside use the outermost cell."""


class Grid:
    """Cells around a mesh: `owner` (i, j, k) a triangle near each, `distance` (i, j, k) m of its middle from the mesh.
    `low` (3,) is the corner of the first cell and `cell` the edge, m."""

    def __init__(self, samples: Array, owners: Indices) -> None:
        low, high = samples.min(axis=0) - MARGIN, samples.max(axis=0) + MARGIN
        self.low: Array = low
        self.cell = float(max(CELL, np.cbrt(np.prod(high - low) / MOST_CELLS)))
        shape = np.ceil((high - low) / self.cell).astype(np.intp)
        inside = np.minimum(((samples - low) / self.cell).astype(np.intp), shape - 1)
        nearest = np.full(shape, -1, dtype=np.int32)
        nearest[inside[:, 0], inside[:, 1], inside[:, 2]] = np.arange(len(samples))
        where = scipy.ndimage.distance_transform_edt(nearest < 0, return_distances=False, return_indices=True)
        nearest = nearest[where[0], where[1], where[2]]
        middles = [low[k] + self.cell * (np.arange(shape[k]) + 0.5) for k in range(3)]
        squared = sum(
            (np.expand_dims(middle, [m for m in range(3) if m != k]) - samples[:, k][nearest]) ** 2
            for k, middle in enumerate(middles)
        )
        self.distance = np.sqrt(squared).astype(np.float32)
        self.owner = owners[nearest].astype(np.int32)


class Walk:
    """Which triangles meet at each corner: those of corner i are `fan[start[i]:start[i + 1]]`."""

    def __init__(self, corners: Array) -> None:
        # Corners at the same place are one, whatever the file says: the walk must get across.
        flat = np.ascontiguousarray(corners.reshape(-1, 3))
        _, merged = np.unique(np.round(flat / 1e-8).astype(np.int64), axis=0, return_inverse=True)
        self.corner_of: NDArray[np.int64] = merged.reshape(-1, 3).astype(np.int64)
        order = np.argsort(self.corner_of.ravel(), kind="stable")
        self.fan = (order // 3).astype(np.int32)
        self.start = np.searchsorted(self.corner_of.ravel()[order], np.arange(merged.max() + 2)).astype(np.int32)


@compiled
def closest(
    points: Array, within: float, low: Array, cell: float, owner: NDArray[np.int32], corners: Array, normals: Array,
    corner_of: NDArray[np.int64], start: NDArray[np.int32], fan: NDArray[np.int32],
) -> tuple[Indices, Indices, Array, Array, Array, NDArray[np.bool_]]:  # fmt: skip
    """Of the points (n, 3) those within `within` m of the mesh (corners (m, 3, 3), unit normals (m, 3)).

    Their indices, the triangles on which their closest points lie, those points and the normals there, how far the
    points are along the normal, and whether the shortest way runs along it.
    """
    many = len(points)
    chosen, hit = np.empty(many, dtype=np.intp), np.empty(many, dtype=np.intp)
    feet, ups = np.empty((many, 3)), np.empty((many, 3))
    heights, upright = np.empty(many), np.empty(many, dtype=np.bool_)
    at = np.empty(3, dtype=np.intp)
    count = 0
    for n in range(many):
        p = points[n, 0], points[n, 1], points[n, 2]
        for i in range(3):
            at[i] = min(max(int((points[n, i] - low[i]) / cell), 0), owner.shape[i] - 1)
        best = int(owner[at[0], at[1], at[2]])
        distance, foot, weights = to_triangle(
            p, (corners[best, 0, 0], corners[best, 0, 1], corners[best, 0, 2]),
            (corners[best, 1, 0], corners[best, 1, 1], corners[best, 1, 2]),
            (corners[best, 2, 0], corners[best, 2, 1], corners[best, 2, 2]),
        )  # fmt: skip
        for _ in range(100):
            if min(weights[0], weights[1], weights[2]) > 0.0:
                break
            largest = 0 if weights[0] >= weights[1] else 1
            largest = largest if weights[largest] >= weights[2] else 2
            pivot = corner_of[best, largest]
            left = best
            for place in range(start[pivot], start[pivot + 1]):
                t = int(fan[place])
                if t == left:
                    continue
                other, better, better_weights = to_triangle(
                    p, (corners[t, 0, 0], corners[t, 0, 1], corners[t, 0, 2]),
                    (corners[t, 1, 0], corners[t, 1, 1], corners[t, 1, 2]),
                    (corners[t, 2, 0], corners[t, 2, 1], corners[t, 2, 2]),
                )  # fmt: skip
                if other < distance:
                    distance, best, foot, weights = other, t, better, better_weights
            if best == left:
                break
        if not distance <= within * within:
            continue
        x, y, z = p[0] - foot[0], p[1] - foot[1], p[2] - foot[2]
        nx, ny, nz = normals[best, 0], normals[best, 1], normals[best, 2]
        height = x * nx + y * ny + z * nz
        aside = np.sqrt((x - height * nx) ** 2 + (y - height * ny) ** 2 + (z - height * nz) ** 2)
        chosen[count], hit[count], heights[count] = n, best, height
        upright[count] = aside <= 2e-5 + 0.3 * abs(height)
        feet[count, 0], feet[count, 1], feet[count, 2] = foot
        ups[count, 0], ups[count, 1], ups[count, 2] = nx, ny, nz
        count += 1
    return chosen[:count], hit[:count], feet[:count], ups[:count], heights[:count], upright[:count]


@compiled
def to_triangle(p: Point, a: Point, b: Point, c: Point) -> tuple[float, Point, Point]:
    """Squared distance (m²) of `p` from the triangle a, b, c, the closest point and its barycentric weights.

    The regions are Ericson's, Real-Time Collision Detection 5.1.5. Tuples: references to arrays are counted at each
    call, which takes longer than the rest.
    """
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = b[i] - a[i], c[i] - a[i]
        d1 += ab * (p[i] - a[i])
        d2 += ac * (p[i] - a[i])
        d3 += ab * (p[i] - b[i])
        d4 += ac * (p[i] - b[i])
        d5 += ab * (p[i] - c[i])
        d6 += ac * (p[i] - c[i])
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    u = v = w = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        u = 1.0
    elif d3 >= 0.0 and d4 <= d3:
        v = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        u = 1.0 - v
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        u = 1.0 - w
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
        u = 1.0 - v - w
    x = u * a[0] + v * b[0] + w * c[0]
    y = u * a[1] + v * b[1] + w * c[1]
    z = u * a[2] + v * b[2] + w * c[2]
    squared = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2
    return squared, (x, y, z), (u, v, w)


SPACING = 0.0004
"""Distance of the samples, m; a larger triangle carries several."""
MOST_SAMPLES = 400_000
WHOLE = (".stl", ".ply")
"""Files that refer to no others."""
UNREADABLE = "mesh {} cannot be read as a mesh; give an STL or PLY"


@dataclass(frozen=True, eq=False)
class Feet:
    """Closest points of n points: `points` (n, 3) m and the model's unit `normals` (n, 3), surface frame.

    `heights` (n,) are the signed distances along the normals, m; `inner` (n,) is True where the point lies over the
    surface: its foot is not on the rim and the shortest way to it runs along the normal.
    """

    points: Array
    normals: Array
    heights: Array
    inner: NDArray[np.bool_]


class NominalSurface:
    """A triangle mesh in the surface frame S, m, with normals by the order of the corners (counter-clockwise outside).

    `rim` is the width in m along the mesh's border that is not used: a scan sees walls and mixed pixels there.
    `source` is the file that it comes from, if any.
    """

    def __init__(
        self, vertices: ArrayLike, triangles: ArrayLike, rim: float = 0.0006, source: Path | None = None
    ) -> None:
        self.source = source
        self.vertices: Array = np.asarray(vertices, dtype=np.float64)
        self.triangles: NDArray[np.int64] = np.asarray(triangles, dtype=np.int64)
        corners = self.vertices[self.triangles]
        if len(corners) == 0 or not np.isfinite(corners).all():
            raise ConfigError(f"the nominal surface has {len(corners)} triangles, or corners that are not numbers")
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice_area = np.linalg.norm(cross, axis=1)
        solid = twice_area > 1e-16
        self.triangles, corners = self.triangles[solid], corners[solid]
        self.areas: Array = 0.5 * twice_area[solid]
        self.normals: Array = cross[solid] / twice_area[solid, None]
        self._corners = np.ascontiguousarray(corners)
        self.samples, self.sample_triangles = _samples(self._corners, self.areas)
        self.grid = Grid(self.samples, self.sample_triangles)
        self._walk = Walk(self._corners)
        self._rim = rim
        border = _border_points(self.vertices, self.triangles)
        self._border = scipy.spatial.cKDTree(border) if len(border) else None
        self._maybe_rim = self._touching_rim()
        self.centre: Array = np.average(self.samples, axis=0, weights=self._sample_weights())
        self.radius = float(np.sqrt(np.mean(np.sum((self.samples - self.centre) ** 2, axis=1))))

    @classmethod
    def load(cls, path: Path, unit: Literal["m", "mm"] = "m", rim: float = 0.0006) -> "NominalSurface":
        """Read an STL or PLY (or another format that trimesh knows); `ConfigError` when it is no usable mesh. The last
        few are kept: one job after another is placed on the same surface, and preparing it takes a while."""
        return _prepared(path, _MeshFile.of(path), unit, rim)

    @property
    def extent(self) -> tuple[Array, Array]:
        """Lowest and highest corner (3,) of the box around the mesh, surface frame, m."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def feet(self, points: ArrayLike, within: float = np.inf) -> tuple[Indices, Feet]:
        """Indices of the points (n, 3), surface frame, that lie within `within` m of the surface, and their feet."""
        p = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        grid, walk = self.grid, self._walk
        chosen, hit, feet, normals, heights, inner = closest(
            p, float(within), grid.low, cell=grid.cell, owner=grid.owner, corners=self._corners, normals=self.normals,
            corner_of=walk.corner_of, start=walk.start, fan=walk.fan,
        )  # fmt: skip
        if self._border is not None:
            doubtful = np.flatnonzero(self._maybe_rim[hit])
            inner[doubtful] &= self._border.query(feet[doubtful], distance_upper_bound=self._rim)[0] > self._rim
        return chosen, Feet(feet, normals, heights, inner)

    def deviations(self, points: ArrayLike, within: float = 0.003) -> Array:
        """Signed distances (…,) in m of points (…, 3), surface frame, from the surface; NaN beside it or farther."""
        p = np.asarray(points, dtype=np.float64)
        flat = p.reshape(-1, 3)
        found = np.full(len(flat), np.nan)
        finite = np.flatnonzero(np.isfinite(flat).all(axis=1))
        chosen, feet = self.feet(flat[finite], within)
        found[finite[chosen]] = np.where(feet.inner, feet.heights, np.nan)
        return found.reshape(p.shape[:-1])

    def coverage(self, points: Array, within: float) -> float:
        """Share of the surface's area, 0 … 1, that has one of the points (n, 3), surface frame, within `within` m."""
        weights = self._sample_weights()
        step = max(1, len(self.samples) // 5000)
        seen = scipy.spatial.cKDTree(points).query(self.samples[::step], distance_upper_bound=within)[0] <= within
        return float(np.sum(weights[::step] * seen) / np.sum(weights[::step]))

    def _touching_rim(self) -> NDArray[np.bool_]:
        """True for the triangles of which some point may lie on the rim."""
        if self._border is None:
            return np.zeros(len(self._corners), dtype=np.bool_)
        middle = self._corners.mean(axis=1)
        reach = np.linalg.norm(self._corners - middle[:, None], axis=2).max(axis=1)
        return np.asarray(self._border.query(middle)[0] <= self._rim + reach)

    def _sample_weights(self) -> Array:
        counts = np.bincount(self.sample_triangles, minlength=len(self.areas))
        return np.asarray(self.areas[self.sample_triangles] / counts[self.sample_triangles])


@dataclass(frozen=True)
class _MeshFile:
    """A mesh file by its content: a copy of it is the same. `place` is where others lie that it may refer to."""

    path: Path = field(compare=False)
    suffix: str
    place: Path | None
    content: bytes

    @classmethod
    def of(cls, path: Path) -> "_MeshFile":
        """The file as it is now; `ConfigError` when it cannot be read."""
        suffix = path.suffix.lower()
        try:
            content = sha256(path.read_bytes()).digest()
        except OSError as error:
            raise ConfigError(UNREADABLE.format(path)) from error
        return cls(path, suffix, None if suffix in WHOLE else path.parent, content)


@lru_cache(maxsize=4)
def _prepared(path: Path, file: _MeshFile, unit: Literal["m", "mm"], rim: float) -> NominalSurface:
    """The surface in a file, of which there may be copies."""
    found = copy(_built(file, unit, rim))
    found.source = path
    return found


@lru_cache(maxsize=4)
def _built(file: _MeshFile, unit: Literal["m", "mm"], rim: float) -> NominalSurface:
    return NominalSurface(*_read(file, unit), rim, file.path)


def read_mesh(path: Path, unit: str) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (n, 3) in m and triangles (m, 3) of a mesh file in `unit`, "m" or "mm".

    Raises `ConfigError` when it is no mesh, or none of a size that a part can be placed onto. The last few are kept, as
    a job's mesh is looked at before it is used: none of the arrays may be written to.
    """
    return _read(_MeshFile.of(path), unit)


@lru_cache(maxsize=4)
def _read(file: _MeshFile, unit: str) -> tuple[Array, NDArray[np.int64]]:
    import trimesh

    path = file.path
    try:
        mesh = trimesh.load_mesh(path, process=False)
        # Corners that are no numbers are looked for first: `process` drops them, and leaves a hole.
        finite = bool(np.isfinite(mesh.vertices).all())
        declared = mesh.metadata.get("_ply_raw", {}).get("face", {}).get("length", 0)
        mesh.process()
        vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
        alike = bool(mesh.is_winding_consistent)
    except Exception as error:  # every reader of trimesh raises its own
        raise ConfigError(UNREADABLE.format(path)) from error
    if len(faces) and len(mesh.faces) < 0.99 * declared:
        raise ConfigError(f"mesh {path} is cut: it holds {len(mesh.faces)} of {declared} triangles; copy it again")
    if vertices.ndim != 2 or not len(faces) or not finite:
        raise ConfigError(
            f"mesh {path} holds {len(faces)} triangles, or corners that are not numbers; give an STL or PLY"
        )
    vertices *= 1.0 if unit == "m" else 1e-3
    extent = float(np.ptp(vertices, axis=0).max())
    if not 0.001 < extent < 5.0:
        raise ConfigError(
            f"mesh {path} measures {1e3 * extent:.3g} mm with mesh_unit = {unit!r} (allowed: 1 to 5000 mm); "
            "check surface.mesh_unit, or part.mesh_unit, in the job; --unit or --part-unit of `cell new-job`"
        )
    if not alike:
        raise ConfigError(
            f"mesh {path}: neighbouring triangles face opposite ways, so nobody knows which side is up; "
            "`cell new-job` turns them, or turn them in the drawing"
        )
    vertices.flags.writeable = faces.flags.writeable = False
    return vertices, faces


def _samples(corners: Array, areas: Array) -> tuple[Array, Indices]:
    """Points on the triangles at about `SPACING`, at least one in each, and the triangle of each point."""
    edge = np.max(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2), axis=1)
    # A long thin triangle is divided as often across as along: it has as many points as its edge squared.
    square = max(areas.sum(), 0.25 * float((edge**2).sum()))
    spacing = max(SPACING, float(np.sqrt(square / MOST_SAMPLES)))
    divisions = np.maximum(1, np.ceil(edge / spacing)).astype(np.intp)
    points, owners = [], []
    for n in np.unique(divisions):
        mine = np.flatnonzero(divisions == n)
        i, j = np.nonzero(np.add.outer(np.arange(n), np.arange(n)) < n)
        weights = [np.column_stack([i + 1 / 3, j + 1 / 3])]
        upper = i + j < n - 1
        weights.append(np.column_stack([i[upper] + 2 / 3, j[upper] + 2 / 3]))
        uv = np.concatenate(weights) / n
        bary = np.column_stack([1.0 - uv.sum(axis=1), uv])
        points.append(np.einsum("sk,tki->tsi", bary, corners[mine]).reshape(-1, 3))
        owners.append(np.repeat(mine, len(bary)))
    return np.concatenate(points), np.concatenate(owners)


def _border_points(vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """Points every 0.2 mm along the edges that belong to one triangle only."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    _, first_seen, count = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_index=True, return_counts=True)
    single = edges[first_seen[count == 1]]
    a, b = vertices[single[:, 0]], vertices[single[:, 1]]
    steps = np.maximum(1, np.ceil(np.linalg.norm(b - a, axis=1) / 2e-4)).astype(np.intp)
    owner = np.repeat(np.arange(len(single)), steps + 1)
    first = np.cumsum(steps + 1) - (steps + 1)
    share = (np.arange(len(owner)) - first[owner]) / steps[owner]
    return np.asarray(a[owner] + share[:, None] * (b - a)[owner])


SIGMA_FLOOR = 3e-6
"""Smallest standard deviation of a point along a normal, m: what a tessellation leaves."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (n, 3) of a scan in the arm base, m.

    `stripe_spread` and `rail_spread` (n, 3) m: what one standard deviation of the stripe centre and of the rail moves
    each point by. The rail's error is common to the points with the same number in `lines` (n,).
    """

    points: Array
    stripe_spread: Array
    rail_spread: Array
    lines: NDArray[np.intp]

    @classmethod
    def of(cls, cloud: Cloud, most: int = 10_000) -> "Scan":
        """At most `most` points, spread evenly over the cloud."""
        lines, rows = cloud.subsample(most)
        spread = cloud.stripe_spread[lines, rows].astype(np.float64)
        return cls(cloud.points[lines, rows], spread, cloud.rail_spread[lines], lines)

    def thinned(self, most: int) -> "Scan":
        """At most `most` points, drawn evenly: a regular stride would fall into step with the rows of the cloud."""
        if len(self.points) <= most:
            return self
        k = np.sort(np.random.default_rng(0).permutation(len(self.points))[:most])
        return Scan(self.points[k], self.stripe_spread[k], self.rail_spread[k], self.lines[k])


@dataclass(frozen=True, eq=False)
class Rows:
    """Linearised correspondences: indices of the points, heights (m), normals, arms and Jacobian (n, 6)."""

    index: NDArray[np.intp]
    heights: Array
    normals: Array
    arms: Array
    jacobian: Array


def correspondences(pose: pin.SE3, scan: Scan, nominal: NominalSurface, gate: float) -> Rows:
    """Points within `gate` m of the surface and over it, with the derivative of their heights by the pose."""
    index, feet = nominal.feet((scan.points - pose.translation) @ pose.rotation, gate)
    keep = feet.inner & (np.abs(feet.heights) < gate)
    index = index[keep]
    normals = feet.normals[keep] @ pose.rotation.T
    arms = scan.points[index] - pose.translation
    jacobian = -np.concatenate([normals, cross(arms, normals)], axis=1)
    return Rows(index, feet.heights[keep], normals, arms, jacobian)


def sigmas_along(scan: Scan, rows: Rows) -> Array:
    """Standard deviations along the normals from the stripe's noise, m."""
    along = np.einsum("ni,ni->n", scan.stripe_spread[rows.index], rows.normals)
    return np.asarray(np.hypot(along, SIGMA_FLOOR))


def robust_scale(ratios: Array) -> float:
    """How many times larger the deviations are than their σ says, at least 1, from their median absolute value."""
    return max(1.0, float(np.median(np.abs(ratios))) / 0.6745) if len(ratios) else 1.0

"""The organised cloud: one line per frame, one place per image row, NaN where there is no point.

It keeps what each point's uncertainty needs, and the raw readings from which it can be solved again under another
calibration. The lines of several sweeps may follow each other in one cloud. Interpolated points are kept apart, so
that nothing takes them for measurements.

Triangles between the neighbours of an organised cloud, none across a depth edge; as PLY or STL."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import Measured, RefusedError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Filled:
    """Points that were interpolated into small holes: where in the cloud, (n,) lines and rows, `points` (n, 3) in m and
    `covariances` (n, 3, 3) in m², base axes."""

    lines: Indices = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    rows: Indices = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    covariances: Array = field(default_factory=lambda: np.empty((0, 3, 3)))


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a sweep, or of several, in the arm base frame, organised as line × row.

    points: (lines, rows, 3) in m, NaN for holes and for rejected points.
    stripe_spread: (lines, rows, 3) float32, m in base axes: where one standard deviation of the stripe centre moves
        the point. The errors of different points are independent.
    rail_spread: (lines, 3), m in base axes: the same for a line's place along the sweep, common to its points.
    centres: (lines, rows) stripe centres in px, with rejected ones; rail: (lines,) rail positions in m.
    rejected: (lines, rows) True where a point was measured and rejected as an outlier.
    flanges: (lines, 4, 4) base_from_flange when each line was taken; empty where that is not known.
    sweeps: (lines,) number of the sweep that each line belongs to, rising from 0; empty for a single sweep.
    filled: what was interpolated.
    """

    points: Array
    stripe_spread: NDArray[np.float32]
    rail_spread: Array
    centres: Array
    rail: Array
    rejected: Mask
    flanges: Array = field(default_factory=lambda: np.empty((0, 4, 4)))
    sweeps: Indices = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    filled: Filled = field(default_factory=Filled)

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and rows."""
        return self.points.shape[0], self.points.shape[1]

    @property
    def valid(self) -> Mask:
        """(lines, rows) True where a point was measured."""
        return np.isfinite(self.points[:, :, 0])

    @property
    def size(self) -> int:
        """Number of measured points."""
        return int(np.count_nonzero(self.valid))

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "lines": self.shape[0],
            "points": self.size,
            "rejected": int(np.count_nonzero(self.rejected)),
            "interpolated": len(self.filled.lines),
        }

    def each_sweep(self) -> list[slice]:
        """The lines of each sweep."""
        if not len(self.sweeps):
            return [slice(0, self.shape[0])]
        ends = np.searchsorted(self.sweeps, np.arange(int(self.sweeps.max()) + 2))
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    def of_sweep(self, number: int) -> Cloud:
        """The measured points of one of its sweeps, as a cloud of their own."""
        lines = self.each_sweep()[number]
        names = ("points", "stripe_spread", "rail_spread", "centres", "rail", "rejected", "flanges")
        own = {name: getattr(self, name)[lines] for name in names}
        return replace(self, **own, sweeps=np.empty(0, dtype=np.intp), filled=Filled())

    def subsample(self, most: int) -> tuple[Indices, Indices]:
        """Indices (line, row) of at most `most` measured points, spread evenly over the cloud."""
        lines, rows = np.nonzero(self.valid)
        if len(lines) <= most:
            return lines, rows
        # One point at random of each stretch: a regular stride falls into step with the rows and leaves most unused.
        within = np.random.default_rng(0).random(most)
        keep = np.floor((np.arange(most) + within) * (len(lines) / most)).astype(np.intp)
        keep = np.unique(np.minimum(keep, len(lines) - 1))
        return lines[keep], rows[keep]

    def covariances(self, lines: Indices, rows: Indices) -> Array:
        """Random part of the covariance (n, 3, 3) in m², base axes, of the points at (lines, rows)."""
        a = self.stripe_spread[lines, rows].astype(np.float64)
        b = self.rail_spread[lines]
        return np.asarray(a[:, :, None] * a[:, None, :] + b[:, :, None] * b[:, None, :])

    def sigma_along(self, lines: Indices, rows: Indices, directions: Array) -> Array:
        """Standard deviations (n,) in m of the points at (lines, rows) along unit `directions` (n, 3), base axes."""
        a = np.einsum("ni,ni->n", self.stripe_spread[lines, rows], directions)
        b = np.einsum("ni,ni->n", self.rail_spread[lines], directions)
        return np.asarray(np.hypot(a, b), dtype=np.float64)

    def require(self, least_points: int = 500) -> Cloud:
        """The cloud itself; raises `RefusedError` when it has fewer than `least_points` measured points."""
        if self.size < least_points:
            raise RefusedError(
                f"the sweep gave {self.size} points in {self.shape[0]} profiles ({int(self.rejected.sum())} rejected), "
                f"at least {least_points} are needed. Check that the laser lights the surface, and the scan camera's "
                "exposure",
                Measured("points of the cloud", self.size, least=least_points),
                Measured("points rejected as outliers", int(self.rejected.sum())),
                Measured("profiles", self.shape[0]),
            )
        return self


def merge(clouds: Sequence[Cloud]) -> Cloud:
    """The clouds of several sweeps as one; each stays organised, its lines follow those of the sweep before.

    Every point keeps its own covariance; what the points of one sweep have in common is kept by `sweeps`. Raises
    ValueError for no clouds, for clouds of different rows, and for one without flange poses beside others.
    """
    if not clouds:
        raise ValueError("there are no clouds to merge")
    if len(clouds) == 1:
        return clouds[0]
    if len(sizes := {cloud.shape[1] for cloud in clouds}) > 1:
        raise ValueError(f"clouds of {sorted(sizes)} rows cannot be merged: one camera, one size")
    if any(len(cloud.flanges) != cloud.shape[0] for cloud in clouds):
        raise ValueError("a cloud that does not know where the flange stood cannot be merged with others")
    first_line = np.concatenate([[0], np.cumsum([cloud.shape[0] for cloud in clouds])])
    names = ("points", "stripe_spread", "rail_spread", "centres", "rail", "rejected", "flanges")
    joined = {name: np.concatenate([getattr(cloud, name) for cloud in clouds]) for name in names}
    filled = Filled(
        np.concatenate([cloud.filled.lines + begin for cloud, begin in zip(clouds, first_line[:-1], strict=True)]),
        np.concatenate([cloud.filled.rows for cloud in clouds]),
        np.concatenate([cloud.filled.points for cloud in clouds]),
        np.concatenate([cloud.filled.covariances for cloud in clouds]),
    )
    numbers = [np.full(cloud.shape[0], k, dtype=np.intp) for k, cloud in enumerate(clouds)]
    return replace(clouds[0], **joined, sweeps=np.concatenate(numbers), filled=filled)


STEEPEST = np.cos(np.radians(80.0))
"""Triangles steeper than this against their sweep's mean normal lie between two surfaces, not on one."""
LONGEST = 3.0
"""Longest edge, in usual distances between lines."""


def triangles(points: Array, line: Indices, row: Indices, sweep: Indices) -> Indices:
    """Triangles (m, 3) of points (n, 3) that lie at (line, row) of their sweep; normals point to the camera.

    Each sweep is meshed by itself: where two overlap there are two sheets, as far apart as the seam says. Raises
    ValueError when no triangle can be made.
    """
    made = [_of_sweep(points, line, row, np.flatnonzero(sweep == k)) for k in np.unique(sweep)]
    faces = np.concatenate(made) if made else np.empty((0, 3), dtype=np.intp)
    if not len(faces):
        raise ValueError(f"{len(points)} points have no neighbours from which a mesh could be made")
    return faces


def _of_sweep(points: Array, line: Indices, row: Indices, mine: Indices) -> Indices:
    first = line[mine].min()
    grid = np.full((line[mine].max() - first + 1, row[mine].max() + 1), -1, dtype=np.intp)
    grid[line[mine] - first, row[mine]] = mine
    a, b, c, d = (g.ravel() for g in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    # Rows run along the image's y axis, lines along its x axis: this order turns towards the camera.
    faces = np.concatenate([np.column_stack([a, b, d]), np.column_stack([b, c, d])])
    faces = np.concatenate([faces, np.column_stack([a, b, c])[d < 0], np.column_stack([a, c, d])[b < 0]])
    faces = faces[(faces >= 0).all(axis=1)]
    if not len(faces):
        return faces
    corners = points[faces]
    edges = corners - np.roll(corners, 1, axis=1)
    lengths = np.linalg.norm(edges, axis=2).max(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mean = normals.sum(axis=0)
    size = np.linalg.norm(normals, axis=1) * np.linalg.norm(mean)
    good = (lengths < LONGEST * np.median(lengths)) & (normals @ mean > STEEPEST * size)
    return np.asarray(faces[good], dtype=np.intp)


def write_mesh(path: Path, points: Array, faces: Indices, colours: NDArray[np.uint8] | None = None) -> int:
    """Write the mesh in metres as PLY, or as binary STL (without colours) when `path` ends so; its triangles' number.

    Vertices that no triangle uses are left out.
    """
    import trimesh

    used, numbers = np.unique(faces, return_inverse=True)
    mesh = trimesh.Trimesh(
        points[used],
        numbers.reshape(faces.shape),
        vertex_colors=None if colours is None else colours[used],
        process=False,
    )
    mesh.export(path, file_type="stl" if path.suffix.lower() == ".stl" else "ply")
    return len(faces)

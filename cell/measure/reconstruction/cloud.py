"""The organised cloud: one line per frame, one place per image row, NaN where there is no point.

It keeps what each point's uncertainty needs, and the raw readings from which it can be solved again under another
calibration. The lines of several sweeps may follow each other in one cloud. Interpolated points are kept apart, so
that nothing takes them for measurements.

A seam says how well two sweeps agree where they overlap. Its figure holds all that a merged cloud leaves unseen within
one sweep: the arm's repeatability, the vehicle's lean, and calibration errors that two poses of the head do not share.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import scipy
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
    def sweep_of(self) -> Indices:
        """(lines,) the number of the sweep that each line belongs to, 0 for a single one."""
        return self.sweeps if len(self.sweeps) else np.zeros(self.shape[0], dtype=np.intp)

    @property
    def size(self) -> int:
        """Number of measured points."""
        return int(np.count_nonzero(self.valid))

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "lines": self.shape[0], "points": self.size, "rejected": int(np.count_nonzero(self.rejected)),
            "interpolated": len(self.filled.lines),
        }  # fmt: skip

    def each_sweep(self) -> list[slice]:
        """The lines of each sweep."""
        if not len(self.sweeps):
            return [slice(0, self.shape[0])]
        ends = np.searchsorted(self.sweeps, np.arange(int(self.sweeps.max()) + 2))
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    def of_sweep(self, number: int) -> Self:
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

    def require(self, least_points: int = 500) -> Self:
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


Motions = Callable[[Indices, Indices], Array]

REACH = 0.0008
"""The other sweep must have a point within this distance, m, else it does not cover the place."""
MOST_POINTS = 3000
LEAST_POINTS = 50
FLAT = 0.0001
"""Neighbours that scatter more than this about their plane, m (rms), lie at an edge and say nothing."""


@dataclass(frozen=True)
class Seam:
    """Two sweeps where they overlap. Distances in m, of the points of `second` from the surface of `first`, along its
    normal: `mean`, `rms`, `p95` of the absolute values; `expected_mean` and `expected_rms` are one standard deviation
    of the mean and the rms to expect from the noise and from what the sweeps do not share; `points` compared."""

    first: int
    second: int
    points: int
    mean: float
    rms: float
    p95: float
    expected_mean: float
    expected_rms: float

    def as_dict(self) -> dict[str, object]:
        """For the journal and the report, in mm."""
        return {
            "sweeps": [self.first, self.second],
            "points": self.points,
            **{
                f"{name}_mm": round(1e3 * float(getattr(self, name)), 4)
                for name in ("mean", "rms", "p95", "expected_mean", "expected_rms")
            },
        }


def find_seams(cloud: Cloud, motions: Motions) -> list[Seam]:
    """Every pair of sweeps that overlap, and how far they lie apart there.

    `motions` gives, for points at (lines, rows), how one standard deviation of each independent systematic error moves
    them: (n, 3, m) in m, base axes, as `sensitivity` makes them. What moves both sweeps alike cancels.
    """
    parts = [_points(cloud, lines) for lines in cloud.each_sweep()]
    trees = [scipy.spatial.cKDTree(cloud.points[lines, rows]) for lines, rows in parts]
    found = []
    for a, b in itertools.combinations(range(len(parts)), 2):
        if min(len(parts[a][0]), len(parts[b][0])) < LEAST_POINTS:
            continue
        seam = _seam(cloud, (a, b), parts, trees[a], motions)
        if seam is not None:
            found.append(seam)
    return found


def _points(cloud: Cloud, lines: slice) -> tuple[Indices, Indices]:
    line, row = np.nonzero(cloud.valid[lines])
    return line + lines.start, row


def _seam(
    cloud: Cloud, pair: tuple[int, int], parts: list[tuple[Indices, Indices]], tree: scipy.spatial.cKDTree,
    motions: Motions,
) -> Seam | None:  # fmt: skip
    (lines_a, rows_a), (lines_b, rows_b) = parts[pair[0]], parts[pair[1]]
    near = tree.query(cloud.points[lines_b, rows_b], k=1, distance_upper_bound=REACH)[0] < REACH
    lines_b, rows_b = lines_b[near], rows_b[near]
    keep = np.unique(np.linspace(0, len(lines_b) - 1, min(MOST_POINTS, len(lines_b))).astype(np.intp))
    lines_b, rows_b = lines_b[keep], rows_b[keep]
    if len(lines_b) < LEAST_POINTS:
        return None
    nearest = np.asarray(tree.query(cloud.points[lines_b, rows_b], k=1)[1])
    beside, full = _around(cloud, cloud.each_sweep()[pair[0]], lines_a[nearest], rows_a[nearest])
    lines_b, rows_b, nearest = lines_b[full], rows_b[full], nearest[full]
    if len(lines_b) < LEAST_POINTS:
        return None
    own, around = cloud.points[lines_b, rows_b], cloud.points[beside[0], beside[1]]
    centre = around.mean(axis=1)
    spread, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around - centre[:, None], around - centre[:, None]))
    # A place at the rim of the other sweep has neighbours on one side only; there its plane would be continued.
    inside = np.linalg.norm(own - centre, axis=1) < REACH
    count = around.shape[1]
    good = inside & (spread[:, 0] / count < FLAT**2) & (spread[:, 1] > 9 * spread[:, 0])
    if good.sum() < LEAST_POINTS:
        return None
    normals, own, centre = vectors[good, :, 0], own[good], centre[good]
    normals = normals * np.sign(normals @ normals[0])[:, None]
    heights = np.einsum("ni,ni->n", own - centre, normals)
    noise = cloud.sigma_along(lines_b[good], rows_b[good], normals) ** 2
    for k in range(count):
        noise += cloud.sigma_along(beside[0][good, k], beside[1][good, k], normals) ** 2 / count**2
    first = nearest[good]
    apart = motions(lines_b[good], rows_b[good]) - motions(lines_a[first], rows_a[first])
    along = np.einsum("ni,nim->nm", normals, apart)
    return Seam(
        first=pair[0], second=pair[1], points=len(heights), mean=float(heights.mean()),
        rms=float(np.sqrt(np.mean(heights**2))), p95=float(np.percentile(np.abs(heights), 95)),
        expected_mean=float(np.sqrt(np.sum(along.mean(axis=0) ** 2) + noise.mean() / len(noise))),
        expected_rms=float(np.sqrt(np.mean(noise + np.sum(along**2, axis=1)))),
    )  # fmt: skip


def _around(cloud: Cloud, sweep: slice, lines: Indices, rows: Indices) -> tuple[tuple[Indices, Indices], Mask]:
    """Lines and rows (m, 15) of the points around those of one sweep at (n,) lines and rows, about as far across the
    lines as along them, and which of the n have all of them."""
    ways = [cloud.points[sweep.start + 1 : sweep.stop] - cloud.points[sweep.start : sweep.stop - 1]]
    ways.append(cloud.points[sweep, 1:] - cloud.points[sweep, :-1])
    lengths = [np.linalg.norm(way, axis=2) for way in ways]
    across, along = (float(np.median(each[each > 0.0])) if (each > 0.0).any() else 0.0 for each in lengths)
    if not across * along > 0.0:
        # Lines or rows without neighbours are no surface to compare with.
        nothing = np.empty((0, 15), dtype=np.intp)
        return (nothing, nothing), np.zeros(len(lines), dtype=np.bool_)
    stride = max(1, round(0.5 * across / along))
    steps = np.array([(i, j * stride) for i in (-1, 0, 1) for j in (-2, -1, 0, 1, 2)])
    line, row = lines[:, None] + steps[:, 0], rows[:, None] + steps[:, 1]
    there = (line >= sweep.start) & (line < sweep.stop) & (row >= 0) & (row < cloud.shape[1])
    line, row = np.where(there, line, sweep.start), np.where(there, row, 0)
    full = (there & cloud.valid[line, row]).all(axis=1)
    return (line[full], row[full]), full

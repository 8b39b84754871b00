"""Do the parts of the surface agree about where it lies?

A robust fit follows whatever most of the surface says, and a surface that is worn like a ramp says that it is tilted.
So each quarter of it is asked by itself: if that quarter alone were as drawn, where would the place be? Quarters that
differ by more than noise and calibration explain leave two answers, and the scan cannot tell which is the right one.

What stands on the place, as the scan saw it: a chip, a burr, a screw that was left there.

The place is told by most of the surface, and a robust fit passes over the few points that do not belong to it. The part
does not: it comes to lie on the highest of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.inversion.nominal import (
    Array,
    Indices,
    NominalSurface,
    Scan,
    correspondences,
    robust_scale,
    sigmas_along,
)
from cell.measure.inversion.observability import Tolerance
from cell.measure.inversion.registration import across
from cell.measure.reconstruction.cloud import Cloud
from drivers.errors import Measured, RefusedError

QUARTER = 0.25
"""Share of the scanned area that is asked by itself."""
STEP = 0.125
"""Share of the area from one quarter to the next, so that they overlap."""
DIRECTIONS = 4
"""The quarters are bands across the surface, in so many directions."""
REACH = 0.006
"""Points farther than this from the surface are foreign objects, m."""
TUKEY = 4.7
"""Standard deviations from which on a point counts nothing."""
MOST_STEPS = 15
BETWEEN = 0.6
"""Share of a quarter's difference that the whole may be off by, one standard deviation."""
RIDGE = 3e-6
"""A motion that moves a quarter by less than this within the tolerance cannot be told from none, m."""


@dataclass(frozen=True, eq=False)
class Dissent:
    """The quarter of the surface that differs most from the whole.

    `shift` (m) and `turn` (rad) from the whole's place to the quarter's own; `excess` the larger of them beyond three
    standard deviations, in tolerances. `middle` (3,) m is where the quarter lies, surface frame. `ways` (6, 3) are
    motions by one tolerance each, along the surface's normal and in its two tilts.
    """

    shift: float
    turn: float
    excess: float
    middle: Array
    ways: Array

    def covariance(self, tolerance: Tolerance) -> Array:
        """What the place may be off by because of it, (6, 6), base axes: a fit to all of the surface lies between what
        its parts say."""
        size = np.array([self.shift / tolerance.translation, *[self.turn / tolerance.rotation] * 2])
        unknown = self.ways * (BETWEEN * max(0.0, self.excess) * size / max(float(size.max()), 1e-12))
        return np.asarray(unknown @ unknown.T)


def dissent(
    scan: Scan, pose: pin.SE3, nominal: NominalSurface, tolerance: Tolerance, moved: Array | None = None
) -> Dissent:
    """The quarter that differs most from base_from_surface `pose`, in height and tilt.

    `moved` (n, 3, m) m, base axes, says what one standard deviation of each parameter of the calibration, or of a
    sweep's pose, does to each point of the scan: what that explains is no dissent. `pose` comes from a registration,
    which saw enough points.
    """
    rows = correspondences(pose, scan, nominal, REACH)
    ways = _ways(pose, nominal, tolerance)
    slopes, noise = rows.jacobian @ ways, sigmas_along(scan, rows)
    local = (scan.points[rows.index] - pose.translation) @ pose.rotation
    by_calibration = np.zeros((len(rows.index), 0))
    if moved is not None:
        by_calibration = np.einsum("ni,nim->nm", rows.normals, moved[rows.index])
        # What the whole follows, its parts follow with it.
        follows = np.linalg.lstsq(rows.jacobian, by_calibration, rcond=None)[0]
        by_calibration = by_calibration - rows.jacobian @ follows
    found = []
    for mine in _quarters(local @ across(nominal)[1].T):
        own, spread = _own_place(rows.heights[mine], slopes[mine], noise[mine], by_calibration[mine])
        motion = ways @ own
        shift, turn = float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))
        excess = _beyond_noise(motion, ways @ spread, tolerance)
        found.append(Dissent(shift, turn, excess, np.median(local[mine], axis=0), ways))
    return max(found, key=lambda each: each.excess)


def _beyond_noise(motion: Array, spread: Array, tolerance: Tolerance) -> float:
    """How far a motion (6,) with a root (6, m) of its covariance goes beyond three sigma, in tolerances."""
    excesses = []
    for part, allowed in ((slice(0, 3), tolerance.translation), (slice(3, 6), tolerance.rotation)):
        size = float(np.linalg.norm(motion[part]))
        sigma = float(np.linalg.norm(motion[part] @ spread[part])) / max(size, 1e-12)
        excesses.append((size - 3.0 * sigma) / allowed)
    return max(excesses)


def _ways(pose: pin.SE3, nominal: NominalSurface, tolerance: Tolerance) -> Array:
    """Motions (6, 3) of the surface by one tolerance each: along its mean normal, and two tilts about its middle.
    Sliding and turning across the surface are left out: a quarter alone often does not determine them."""
    normal, sides = across(nominal)
    turn, middle = pose.rotation, pose.rotation @ nominal.centre
    ways = np.zeros((6, 3))
    ways[:3, 0] = tolerance.translation * (turn @ normal)
    ways[3:, 1:] = tolerance.rotation * (turn @ sides.T)
    ways[:3, 1:] = -np.cross(ways[3:, 1:].T, middle).T
    return ways


def _quarters(places: Array) -> Iterator[NDArray[np.intp]]:
    """Indices of the points (n, 2), across the surface, in bands that hold a quarter of them each."""
    centred = places - places.mean(axis=0)
    values, axes = np.linalg.eigh(centred.T @ centred)
    scaled = centred @ axes / np.sqrt(np.maximum(values, 1e-12 * values.max()))
    for angle in np.pi / DIRECTIONS * np.arange(DIRECTIONS):
        order = np.argsort(scaled @ np.array([np.cos(angle), np.sin(angle)]), kind="stable")
        for begin in np.arange(0.0, 1.0 - QUARTER + 1e-9, STEP):
            yield order[int(begin * len(order)) : int((begin + QUARTER) * len(order))]


def _own_place(heights: Array, slopes: Array, sigmas: Array, by_calibration: Array) -> tuple[Array, Array]:
    """Where points alone put the surface (3,), in tolerances, and a root (3, m) of its covariance."""
    found, gain, scale = np.zeros(3), np.zeros((3, len(heights))), 1.0
    for _ in range(MOST_STEPS):
        left = heights + slopes @ found
        scale = robust_scale(left / sigmas)
        ratio = left / (TUKEY * scale * sigmas)
        weights = np.where(np.abs(ratio) < 1.0, (1.0 - ratio**2) ** 2, 0.0) / sigmas**2
        weighted = slopes.T * (weights / weights.sum())
        gain = np.linalg.solve(weighted @ slopes + RIDGE**2 * np.eye(3), weighted)
        step = -gain @ heights - found
        found = found + step
        if np.abs(step).max() < 1e-3:
            break
    return found, np.concatenate([gain * (scale * sigmas), gain @ by_calibration], axis=1)


REACH_M = 6e-3
"""Farther from what is drawn, part or surface, a point belongs to something else."""
SQUARE_M, LEAST_POINTS, LEAST_LINES = 2e-3, 8, 2
"""Squares over which heights are taken together, and what one needs to count: a single line may be a reflection."""
ROWS = 100_000
"""More than a part has of them to either side."""
STEEPEST = 0.5
"""Cosine of the slope beyond which a height along the normal is one to the side."""
SIGMAS = 4.0
"""Of a square's own noise, by which it has to be the higher."""
ALLOWED = 0.5
"""Share of the place's tolerance that a part may be lifted by: what else it may be off by has the rest."""


@dataclass(frozen=True, eq=False)
class Standing:
    """The highest square: it would lift a part by `height`, m, at least; its middle at `at` (3,), m, surface frame.
    `seen` is the share of the surface below the part, as drawn, with a square that has points enough."""

    height: float
    at: Array
    seen: float


def highest_standing(
    cloud: Cloud, nominal: NominalSurface, pose: pin.SE3, surface_from_part: pin.SE3, size: Sequence[float]
) -> Standing | None:
    """What stands highest on the surface at `pose` (base_from_surface) below a part of this `size`, m, beyond noise.

    The part lies at `surface_from_part`, its mating face up to half of its size about its origin. None where no square
    has points enough.
    """
    lines, rows = np.nonzero(cloud.valid)
    local = (cloud.points[lines, rows] - pose.translation) @ pose.rotation
    # However high: the part comes down onto it from above all of it.
    index, feet = nominal.feet(local)
    places = local[index]
    below = (places - surface_from_part.translation) @ surface_from_part.rotation
    axis, half = surface_from_part.rotation[:, 2], 0.5 * np.asarray(size)[:2]
    up = feet.normals @ axis
    kept = feet.inner & (up > STEEPEST) & (np.abs(below[:, :2]) <= half).all(axis=1)
    if not kept.any():
        return None
    line, lift, below, places = lines[index[kept]], (feet.heights / up)[kept], below[kept], places[kept]
    # Squares that overlap by half: in some of them a small thing is in the middle.
    each = [squares(square_of(below, shift), lift, line) for shift in np.ndindex(2, 2)]
    medians, middle, noise = (np.concatenate(of_all) for of_all in zip(*each, strict=True))
    if not len(medians):
        return None
    drawn = nominal.samples[nominal.normals[nominal.sample_triangles] @ axis > STEEPEST]
    drawn = (drawn - surface_from_part.translation) @ surface_from_part.rotation
    face = np.unique(square_of(drawn[(np.abs(drawn[:, :2]) <= half).all(axis=1)]))
    seen = np.isin(face, square_of(below[each[0][0]])).mean() if len(face) else 0.0
    best = int(np.argmax(middle - noise))
    return Standing(float(middle[best] - noise[best]), places[medians[best]], float(seen))


def square_of(places: Array, shift: tuple[int, ...] = (0, 0)) -> Indices:
    """The number (n,) of the square of 2 mm, across x and y, in which each place (n, 3), m, lies. The squares may be
    shifted by half a one."""
    column, row = np.floor(places[:, :2] / SQUARE_M + 0.5 * np.array(shift)).astype(np.intp).T
    return np.asarray(column * 2 * ROWS + row)


def spread_mm(values: Array, digits: int) -> tuple[float, ...]:
    """The least, the middle and the largest of `values` (n,), m, in mm."""
    return tuple(round(1e3 * float(v), digits) + 0.0 for v in np.percentile(values, [0, 50, 100]))


def spread_for_journal(values: Array, seen: float) -> dict[str, float]:
    """The same with the share that was `seen`."""
    least, middle, most = spread_mm(values, 4)
    return {"least_mm": least, "median_mm": middle, "largest_mm": most, "seen": round(seen, 3)}


def squares(square: Indices, heights: Array, line: Indices) -> tuple[Indices, Array, Array]:
    """Of each of the squares (n,) with points enough the point of its median height, that height, m, and `SIGMAS` of
    its noise, m. The points come from the lines (n,) of a scan."""
    _, owner = np.unique(square, return_inverse=True)
    count = np.bincount(owner)
    medians, middle = _medians(owner, heights, count)
    # Points of one line share most of their noise.
    each = int(line.max()) + 1
    taken = np.bincount(np.unique(owner * each + line) // each)
    _, spread = _medians(owner, np.abs(heights - middle[owner]), count)
    enough = np.flatnonzero((count >= LEAST_POINTS) & (taken >= LEAST_LINES))
    return medians[enough], middle[enough], (SIGMAS * 1.4826 * spread / np.sqrt(taken))[enough]


def _medians(owner: Indices, values: Array, count: Indices) -> tuple[Indices, Array]:
    """Of each owner's values the middle one, and where it is."""
    middle = np.lexsort((values, owner))[np.cumsum(count) - count + count // 2]
    return middle, values[middle]


def require_bare(found: Standing | None, tolerance: float) -> Standing:
    """What was found on a place of this `tolerance`, m; `RefusedError` where that lifts a part, or nothing was seen."""
    allowed = ALLOWED * tolerance
    if found is None:
        raise RefusedError(
            "the scan shows nothing of the surface below the part: whether something stands there is not known. See "
            "that place.surface_from_part and grasp.size are right, or widen scan.swath or scan.length, and sweep again"
        )
    if found.height <= allowed:
        return found
    x, y, z = 1e3 * found.at
    raise RefusedError(
        f"something stands {1e3 * found.height:.2f} mm out of the surface at ({x:.0f}, {y:.0f}, {z:.0f}) mm, as the "
        f"scan saw it: the part would come to lie on it. Allowed are {1e3 * allowed:.2f} mm, half of the place's "
        "tolerance. Look what it is (a chip, a burr, a drop), then run the job again from its sweep",
        Measured("stands out of the surface", 1e3 * found.height, "mm", most=1e3 * allowed),
    )

"""Is the place pose known well enough in every direction, and which motion is not?

The covariance is judged in units of the job's tolerances; the motion that exceeds them, or that only the board and not
the scan determines, is put into words.

Small motions of a surface in words: translations along axes, rotations about lines, and screws.

Motions that are undetermined together come out of an eigendecomposition mixed at will. They are sorted into pure
translations first and rotations after, along the axes of the surface frame where the mixture allows it."""

from dataclasses import dataclass

import numpy as np

from cell.measure.inversion.nominal import Array
from drivers.errors import Measured, NotObservable

PURE = 0.15
"""Share of rotation, in units of the surface's radius, up to which a motion counts as a translation."""


def sorted_out(ways: Array, radius: float) -> list[Array]:
    """Motions (6,) (shift m, turn rad) that span the same as the columns of `ways` (6, k), as plain as they can be."""
    scaled = ways * np.array([1.0] * 3 + [radius] * 3)[:, None]
    basis = np.linalg.svd(scaled, full_matrices=False)[0]
    _, sizes, mixes = np.linalg.svd(basis[3:])
    sizes = np.append(sizes, np.zeros(max(0, len(mixes) - len(sizes))))
    slides = basis @ mixes[sizes <= PURE].T
    turning = basis @ mixes[sizes > PURE].T
    found = [np.append(axis, np.zeros(3)) for axis in _aligned(slides[:3])]
    for axis in _aligned(turning[3:]):
        mix = np.linalg.pinv(turning[3:] / radius) @ axis
        found.append(turning @ mix / np.array([1.0] * 3 + [radius] * 3))
    return found


def name(motion: Array, radius: float) -> str:
    """A motion (shift m, turn rad) in the surface frame in words, the line of a rotation by its point nearest to
    the origin unless it passes there."""
    shift, turn = motion[:3], motion[3:]
    angle = float(np.linalg.norm(turn))
    if angle * radius <= 0.2 * float(np.linalg.norm(shift)):
        return f"translation along {_axis(shift)}"
    axis = turn / angle
    along = float(shift @ axis)
    # The line that stays where it is: shift = −turn × point for the point nearest to the origin.
    point = np.cross(axis, shift - along * axis) / angle
    where = ""
    if np.linalg.norm(point) > 0.05 * radius:
        x, y, z = 1e3 * point
        where = f" through ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    pitch = along / angle
    if abs(pitch) > 0.3 * radius:
        where += f" with {1e3 * pitch:+.1f} mm/rad along it"
    return f"rotation about {_axis(axis)}{where}"


def _aligned(directions: Array) -> list[Array]:
    """Unit vectors (3,) that span the columns of `directions` (3, k), along the coordinate axes where they can be."""
    if directions.shape[1] == 0:
        return []
    basis = np.linalg.svd(directions, full_matrices=False)[0]
    count = basis.shape[1]
    if count == 3:
        return list(np.eye(3))
    if count == 1:
        return [basis[:, 0] * np.sign(basis[np.argmax(np.abs(basis[:, 0])), 0])]
    normal = np.cross(basis[:, 0], basis[:, 1])
    nearest = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = nearest - normal * float(normal @ nearest)
    first = first / np.linalg.norm(first)
    second = np.cross(normal, first)
    return [first, second * np.sign(second[np.argmax(np.abs(second))])]


def _axis(vector: Array) -> str:
    direction = vector / np.linalg.norm(vector)
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.97:
        return f"the {'xyz'[largest]} axis of the surface frame"
    x, y, z = direction * np.sign(direction[largest])
    return f"({x:.2f}, {y:.2f}, {z:.2f}) in the surface frame"


FREE = 1e-3
"""Smallest eigenvalue of the scan's information, per point and σ, below which a motion counts as not determined by the
scan (docs/explanation/theory.md, section 9)."""


FEW = 0.01
"""A motion that fewer of the points tell than this share counts as not determined either: those of an upright wall, or
of a drawing's facets. An error that they share does not average out, nor is it sure that they lie on the right wall."""


@dataclass(frozen=True)
class Tolerance:
    """What the job allows: translation in m, rotation in rad."""

    translation: float
    rotation: float

    def __post_init__(self) -> None:
        if not (0.0 < self.translation < 1.0 and 0.0 < self.rotation < 1.0):
            raise ValueError(
                f"tolerances {self.translation} m and {self.rotation} rad must lie between 0 and 1 m, 0 and 1 rad"
            )


@dataclass(frozen=True, eq=False)
class SmallMotion:
    """A small motion of the surface: `shift` (3,) m of its origin and `turn` (3,) rad, in the surface frame, at three
    standard deviations; `excess` is its size in units of the tolerance; `words` name it."""

    shift: Array
    turn: Array
    excess: float
    words: str

    def measured(self) -> Measured:
        """Its size beside the tolerance, under a short name."""
        name, _, _ = self.words.partition(" is ")
        return Measured(f"3σ in tolerances: {name.replace(' of the surface frame', '')}", self.excess, most=1.0)


@dataclass(frozen=True, eq=False)
class PoseVerdict:
    """What is known of the pose. worst: the least certain motion, in units of the tolerance. weak: the motions beyond
    tolerance, worst first. unseen: motions that the scan alone does not determine, so that the board decides them."""

    worst: SmallMotion
    weak: tuple[SmallMotion, ...]
    unseen: tuple[str, ...]

    def require(self) -> None:
        """Raise `NotObservable` that names every motion that is not known well enough."""
        if self.weak:
            motions = "; ".join(motion.words for motion in self.weak)
            raise NotObservable(
                f"{motions}. Scan more of the surface, one with more relief, or photograph the board more often",
                *(motion.measured() for motion in self.weak),
            )


def determined(rows: Array, radius: float) -> tuple[Array, Array]:
    """The information (6, 6) of a scan on the motions that more than a few of its points tell, and what is left of the
    scan's pull (6,) on the pose without the others, as a matrix (6, 6) to take it with.

    `rows` (n, 6), surface frame: by how many σ each point's distance from the surface changes with the pose. How many
    points tell a motion is (Σ c)²/Σ c², c each one's part of what is known of it.
    """
    length = np.array([1.0] * 3 + [radius] * 3)
    values, ways = np.linalg.eigh((rows / length).T @ (rows / length))
    parts = (rows / length @ ways) ** 2
    tellers = parts.sum(axis=0) ** 2 / np.maximum((parts**2).sum(axis=0), np.finfo(float).tiny)
    kept = np.where(tellers < FEW * len(rows), 0.0, 1.0)
    told = (ways * values * kept) @ ways.T * np.outer(length, length)
    return np.asarray(told), np.asarray((ways * kept) @ ways.T * np.outer(length, 1.0 / length))


def judge(
    covariance: Array, scan_information: Array, mean_variance: float, points: int, radius: float, tolerance: Tolerance
) -> PoseVerdict:
    """Judge a 6×6 `covariance` (translation, rotation; surface frame) against `tolerance`.

    `scan_information` is the 6×6 information of the scan alone in the same frame, made of `points` points of variance
    `mean_variance` (m²); `radius` is the surface's rms radius in m.
    """
    unit = np.array([tolerance.translation] * 3 + [tolerance.rotation] * 3)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    sizes = 3.0 * np.sqrt(np.maximum(values, 0.0))
    worst = _motion(sizes[-1] * vectors[:, -1] * unit, float(sizes[-1]), tolerance, radius)
    beyond = ~(sizes <= 1.0)
    weak = [
        _motion(size * way * unit, float(size), tolerance, radius)
        for size, way in zip(sizes[beyond], vectors.T[beyond], strict=True)
    ]
    if beyond.sum() > 1:
        plain = [
            _sized(way, covariance, tolerance, radius) for way in sorted_out(unit[:, None] * vectors[:, beyond], radius)
        ]
        # Correlated motions can each stay within the tolerance while their mixture does not: then the mixture is named.
        weak = plain if all(motion.excess > 1.0 for motion in plain) else weak
    weak.sort(key=lambda motion: -motion.excess)
    length = np.array([1.0] * 3 + [radius] * 3)
    spectrum, ways = np.linalg.eigh(scan_information / np.outer(length, length) * (mean_variance / max(1, points)))
    free = ways[:, spectrum < FREE] / length[:, None]
    unseen = tuple(name(way, radius) for way in sorted_out(free, radius)) if free.size else ()
    return PoseVerdict(worst, tuple(weak), unseen)


def _sized(way: Array, covariance: Array, tolerance: Tolerance, radius: float) -> SmallMotion:
    """The motion along `way` (6,), a unit shift or a unit turn, at three of its standard deviations."""
    turn = float(np.linalg.norm(way[3:]))
    pure = turn * radius <= 0.2 * float(np.linalg.norm(way[:3]))
    block, unit = (slice(0, 3), way[:3] / np.linalg.norm(way[:3])) if pure else (slice(3, 6), way[3:] / turn)
    size = 3.0 * float(np.sqrt(unit @ covariance[block, block] @ unit))
    allowed, shown = (tolerance.translation, "mm") if pure else (tolerance.rotation, "mrad")
    motion = way * (size / (float(np.linalg.norm(way[:3])) if pure else turn))
    words = f"{name(motion, radius)} is not determined: 3σ {_against(1e3 * size, 1e3 * allowed, shown)}"
    return SmallMotion(motion[:3], motion[3:], size / allowed, words)


def _motion(motion: Array, excess: float, tolerance: Tolerance, radius: float) -> SmallMotion:
    shift, turn = motion[:3], motion[3:]
    parts = []
    size, angle = float(np.linalg.norm(shift)), float(np.linalg.norm(turn))
    if angle * radius > 0.2 * size:
        parts.append(_against(1e3 * angle, 1e3 * tolerance.rotation, "mrad"))
    if size > 0.2 * angle * radius:
        parts.append(_against(1e3 * size, 1e3 * tolerance.translation, "mm"))
    state = "is not determined" if excess > 1.0 else "is known"
    return SmallMotion(shift, turn, excess, f"{name(motion, radius)} {state}: 3σ {' and '.join(parts)}")


def _against(value: float, allowed: float, unit: str) -> str:
    return f"{value:.3g} {unit} {'>' if value > allowed else '≤'} {allowed:.3g} {unit}"

"""Is the place pose known well enough in every direction, and which motion is not? And what a scan has to be like.

The covariance is judged in units of the job's tolerances; the motion that exceeds them, or that only the board and not
the scan determines, is put into words: translations along axes, rotations about lines, and screws. Motions that are
undetermined together come out of an eigendecomposition mixed at will. They are sorted into pure translations first and
rotations after, along the axes of the surface frame where the mixture allows it.

What a scan has to be like for its place pose to be believed are reasons to refuse it, in words and figures. Each
comparison asks whether the figure is good: one that is no number is refused as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.measure.inversion.disagreement import Dissent
from cell.measure.inversion.nominal import Array, NominalSurface, Scan
from cell.measure.inversion.registration import Prior, Registration, across
from drivers.errors import Measured, NotObservable, RefusedError

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
    """What is known of the pose.

    worst: the least certain motion, in units of the tolerance. weak: the motions beyond tolerance, worst first.
    unseen: motions that the scan alone does not determine, so that the board decides them.
    """

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


BOARD_DISAGREES = 40.0
"""Squared Mahalanobis distance between scan and board from which on they contradict each other (6 degrees of freedom:
five in ten million by chance)."""

SQUARE, SQUARE_POINTS = 0.004, 8
"""Edge of the squares over which distances are taken together, m, and the points that one needs to count."""


@dataclass(frozen=True)
class Demands:
    """What a scan has to be like to be believed.

    coverage: share of the surface that has points; share: points over the surface that fit it; rms: of those, m;
    departed: share of the scanned area that may lie off the surface by more than the tolerances move it; dissent: how
    far from the whole's place a quarter of the surface may put it, beyond three standard deviations, in tolerances.
    """

    coverage: float = 0.35
    share: float = 0.6
    rms: float = 0.0003
    departed: float = 0.22
    dissent: float = 0.5


def fit_figures(
    coverage: float, share: float, rms: float, chi2_per_dof: float, demands: Demands | None = None
) -> tuple[Measured, ...]:
    """How well a scan fits the surface, for people: each figure (those of `PlacePose`) beside what is demanded."""
    demands = demands or Demands()
    return (
        Measured("fit, χ²/dof", chi2_per_dof, about=1.0),
        Measured("surface covered", 100 * coverage, "%", least=100 * demands.coverage),
        Measured("points over the surface that fit it", 100 * share, "%", least=100 * demands.share),
        Measured("points off the surface, RMS", 1e3 * rms, "mm", most=1e3 * demands.rms),
    )


def require_fit(found: Registration, coverage: float, demands: Demands) -> None:
    """Refuse a scan that is not like the surface."""
    if not coverage >= demands.coverage:
        raise RefusedError(
            f"the scan covers {100 * coverage:.0f} % of the nominal surface, at least "
            f"{100 * demands.coverage:.0f} % is needed. Lengthen the sweep or check where the surface lies"
        )
    if not found.share >= demands.share:
        raise RefusedError(
            f"{100 * found.share:.0f} % of the points over the nominal surface fit it, at least "
            f"{100 * demands.share:.0f} % must. Is it the right surface, clean and whole?"
        )
    if not found.rms <= demands.rms:
        raise RefusedError(
            f"the points lie {1e3 * found.rms:.3f} mm (rms) off the nominal surface, at most "
            f"{1e3 * demands.rms:.3f} mm is allowed. Is the surface deformed, or the calibration disturbed?"
        )


def require_whole(scan: Scan, pose: pin.SE3, nominal: NominalSurface, tolerance: Tolerance, demands: Demands) -> None:
    """Refuse a surface of which too much lies off the nominal one: points that fit elsewhere do not excuse it.

    A robust fit finds the part of a bent or broken surface that agrees with the model, and a pose with it. Medians over
    squares bring to light what the noise of single points hides.
    """
    allowed = min(tolerance.translation / 3, tolerance.rotation * nominal.radius)
    medians = _squares(scan, pose, nominal)
    departed = float(np.mean(~(np.abs(medians) <= allowed))) if len(medians) else 1.0
    if not departed <= demands.departed:
        raise RefusedError(
            f"{100 * departed:.0f} % of the scanned area lies more than {1e3 * allowed:.2f} mm off the nominal "
            f"surface, at most {100 * demands.departed:.0f} % may. Is the surface deformed, worn "
            "or covered, is it another one, or is the calibration disturbed?",
            Measured(
                f"area more than {1e3 * allowed:.2f} mm off the surface",
                100 * departed,
                "%",
                most=100 * demands.departed,
            ),
        )


def require_agreement(found: Dissent, tolerance: Tolerance, demands: Demands) -> float:
    """Refuse a surface of which a quarter by itself puts the place elsewhere; else how far it does beyond its noise,
    in tolerances."""
    if not found.excess <= demands.dissent:
        x, y, z = 1e3 * found.middle
        shift, turn = 1e3 * demands.dissent * tolerance.translation, 1e3 * demands.dissent * tolerance.rotation
        raise RefusedError(
            f"the parts of the surface do not agree: the quarter around ({x:.0f}, {y:.0f}, {z:.0f}) mm by itself puts "
            f"the place {1e3 * found.shift:.2f} mm and {1e3 * found.turn:.1f} mrad elsewhere, allowed beyond its noise "
            f"are {shift:.2f} mm and {turn:.1f} mrad. Which part is right cannot be told: is the surface worn, bent or "
            "broken, does something lie on it, or is the calibration disturbed?",
            Measured("a quarter of the surface puts the place off by", 1e3 * found.shift, "mm"),
            Measured("and turned by", 1e3 * found.turn, "mrad"),
            Measured("both, beyond their noise", found.excess, "tolerances", most=demands.dissent),
        )
    return max(0.0, found.excess)


def _squares(scan: Scan, pose: pin.SE3, nominal: NominalSurface) -> Array:
    """Median distances (k,) in m from the surface over squares of `SQUARE` m that hold enough points."""
    local = (scan.points - pose.translation) @ pose.rotation
    index, feet = nominal.feet(local, 0.006)
    index, heights = index[feet.inner], feet.heights[feet.inner]
    if len(index) == 0:
        return np.empty(0)
    cells = np.floor(local[index] @ across(nominal)[1].T / SQUARE).astype(np.intp)
    _, owner, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    groups = np.split(heights[np.argsort(owner, kind="stable")], np.cumsum(count)[:-1])
    return np.array([np.median(group) for group in groups if len(group) >= SQUARE_POINTS])


def require_board(shared: Array, prior: Prior, correction: Array) -> None:
    """Refuse a pose that contradicts the board, by the squared Mahalanobis distance between the two.

    A direction that the scan does not determine stays where the board put it and adds nothing.
    """
    distance = float(correction @ np.linalg.solve(prior.covariance + shared, correction))
    if not distance <= BOARD_DISAGREES:
        raise RefusedError(
            f"scan and board disagree: the surface lies {1e3 * float(np.linalg.norm(correction[:3])):.2f} mm and "
            f"{np.degrees(np.linalg.norm(correction[3:])):.2f} deg from where the board puts it (squared distance "
            f"{distance:.0f} in units of the prior, allowed {BOARD_DISAGREES:.0f}). Was the board or the surface "
            "moved?",
            Measured("surface off where the board puts it", 1e3 * float(np.linalg.norm(correction[:3])), "mm"),
            Measured("and turned", float(np.degrees(np.linalg.norm(correction[3:]))), "deg"),
            Measured("squared distance in units of the prior", distance, most=BOARD_DISAGREES),
        )

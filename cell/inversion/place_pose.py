"""From the cloud to the place pose: registration, its whole uncertainty, and the reasons to refuse it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.geometry.poses import difference
from cell.inversion.closest import Array
from cell.inversion.correspondences import Scan
from cell.inversion.dissent import Dissent, dissent
from cell.inversion.nominal import NominalSurface
from cell.inversion.observability import Tolerance, Verdict, judge
from cell.inversion.registration import Prior, Registration, register
from cell.inversion.search import across
from cell.inversion.sweeps import balance
from cell.reconstruction.cloud import Cloud
from drivers.errors import Measured, RefusedError

BOARD_DISAGREES = 40.0
"""Squared Mahalanobis distance between scan and board from which on they contradict each other (6 degrees of freedom:
five in ten million by chance)."""

SQUARE, SQUARE_POINTS = 0.004, 8
"""Edge of the squares over which distances are taken together, m, and the points that one needs to count."""


@dataclass(frozen=True)
class Demands:
    """What a scan has to be like to be believed.

    coverage: share of the surface that has points; share: points over the surface that fit it; rms: of those, m;
    departed: share of the scanned area that may lie off the surface by more than `departure` allows; dissent: how far
    from the whole's place a quarter of the surface may put it, beyond three standard deviations, in tolerances.
    """

    coverage: float = 0.35
    share: float = 0.6
    rms: float = 0.0003
    departed: float = 0.22
    dissent: float = 0.5


@dataclass(frozen=True, eq=False)
class PlacePose:
    """Where the surface is, and how well that is known.

    base_from_surface: the pose. random, systematic, covariance (their sum): 6×6 of (translation, rotation) in base axes
    about the surface's origin, m² and rad²; random from the stripe, the rail and the prior, systematic from what the
    caller said of the calibration.
    verdict: is every direction known well enough; its words are in the surface frame.
    rms: of the accepted points' distances, m; chi2_per_dof: the same in units of their noise; n_points: accepted;
    share: accepted among those over the surface; coverage: share of the surface that was seen.
    parts_differ: how far from this place a quarter of the surface puts it, beyond three sigma, in tolerances.
    correction: (6,) from the board's pose to this one, base axes, m and rad; disagreement: squared Mahalanobis distance
    between the two. notes: for people, what is not as usual.
    """

    base_from_surface: pin.SE3
    random: Array
    systematic: Array
    covariance: Array
    verdict: Verdict
    rms: float
    chi2_per_dof: float
    n_points: int
    share: float
    coverage: float
    parts_differ: float
    correction: Array
    disagreement: float
    notes: tuple[str, ...] = ()

    @property
    def sigma(self) -> Array:
        """Standard deviations (6,): translation in m, rotation in rad, base axes."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "points": self.n_points,
            "rms_mm": round(1e3 * self.rms, 4),
            "chi2_per_dof": round(self.chi2_per_dof, 3),
            "share": round(self.share, 4),
            "coverage": round(self.coverage, 3),
            "parts_differ": round(self.parts_differ, 3),
            "correction_mm": [round(1e3 * float(v), 3) for v in self.correction[:3]],
            "correction_mrad": [round(1e3 * float(v), 3) for v in self.correction[3:]],
            "sigma_mm": [round(1e3 * float(v), 4) for v in self.sigma[:3]],
            "sigma_mrad": [round(1e3 * float(v), 4) for v in self.sigma[3:]],
            "least_known": self.verdict.worst.words,
            "decided_by_board": list(self.verdict.unseen),
        }


Resolve = Callable[[NDArray[np.intp], NDArray[np.intp]], Array]
"""Gives, for points at (line, row), how one standard deviation of each independent calibration parameter moves them:
(n, 3, m) in m, base axes."""


def invert_pose(
    cloud: Cloud,
    nominal: NominalSurface,
    prior: Prior,
    tolerance: Tolerance,
    *,
    systematic: Array | None = None,
    calibration: Resolve | None = None,
    sweeps: Resolve | None = None,
    start: pin.SE3 | None = None,
    demands: Demands | None = None,
    most_points: int = 10_000,
) -> PlacePose:
    """The pose of the nominal surface in the arm base, from a cloud in the arm base and the board's pose as prior.

    `systematic` (6×6, base axes) is an uncertainty of the pose that all points share, such as the arm's; `calibration`
    says how the calibration's uncertainty moves each point, and is propagated through the registration; `sweeps` how
    each sweep's own uncertainty moves its points, which is taken out as far as the sweeps tell it. `start` is where the
    search begins unless at the prior.

    Raises `RefusedError` when the scan does not fit the surface, covers too little of it or contradicts the board, and
    `NotObservable` when three standard deviations exceed `tolerance` in some direction, which is named.
    """
    demands = demands or Demands()
    scan = Scan.of(cloud, most_points)
    found = register(scan, nominal, prior, start)
    pose = found.base_from_surface
    local = (scan.points[found.used] - pose.translation) @ pose.rotation
    coverage = nominal.coverage(local, 0.0025)
    numbers = fit_figures(coverage, found.share, found.rms, found.chi2_per_dof, demands)
    with _shown(pose, *numbers):
        _demand(found, coverage, demands)
        _demand_whole(scan, pose, nominal, tolerance, demands)
    lines, rows = cloud.subsample(most_points)
    displaced = [resolve(lines, rows) for resolve in (calibration, sweeps) if resolve is not None]
    if sweeps is not None:
        found = balance(found, scan, displaced[-1][found.used], prior)
        pose = found.base_from_surface
    explained = np.concatenate(displaced, axis=2) if displaced else None
    with _shown(pose, *numbers):
        parts_differ = _demand_agreement(dissent(scan, pose, nominal, tolerance, explained), tolerance, demands)
    shared = np.zeros((6, 6)) if systematic is None else found.gain @ systematic @ found.gain.T
    for moved in displaced:
        by_parameter = found.follow @ np.einsum("ni,nim->nm", found.normals, moved[found.used])
        shared = shared + by_parameter @ by_parameter.T
    covariance = found.covariance + shared
    correction = difference(pose, prior.base_from_surface)
    with _shown(pose, *numbers):
        disagreement = _disagreement(shared, prior, correction)
    turn = np.kron(np.eye(2), pose.rotation.T)
    verdict = judge(
        turn @ covariance @ turn.T,
        turn @ found.scan_information @ turn.T,
        float(1.0 / np.mean(1.0 / found.sigmas**2)),
        len(found.used),
        nominal.radius,
        tolerance,
    )
    with _shown(pose, *numbers):
        verdict.require()
    return PlacePose(
        base_from_surface=pose,
        random=found.covariance,
        systematic=np.asarray(shared),
        covariance=np.asarray(covariance),
        verdict=verdict,
        rms=found.rms,
        chi2_per_dof=found.chi2_per_dof,
        n_points=len(found.used),
        share=found.share,
        coverage=coverage,
        parts_differ=parts_differ,
        correction=correction,
        disagreement=disagreement,
    )


@contextmanager
def _shown(pose: pin.SE3, *numbers: Measured) -> Iterator[None]:
    """A refusal in this block also shows the candidate "pose" that was judged, and `numbers`."""
    try:
        yield
    except RefusedError as refused:
        refused.showing(*numbers, seen={"pose": pose})
        raise


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


def _demand(found: Registration, coverage: float, demands: Demands) -> None:
    """Refuse a scan that is not like the surface."""
    if coverage < demands.coverage:
        raise RefusedError(
            f"the scan covers {100 * coverage:.0f} % of the nominal surface, at least "
            f"{100 * demands.coverage:.0f} % is needed. Lengthen the sweep or check where the surface lies"
        )
    if found.share < demands.share:
        raise RefusedError(
            f"{100 * found.share:.0f} % of the points over the nominal surface fit it, at least "
            f"{100 * demands.share:.0f} % must. Is it the right surface, clean and whole?"
        )
    if found.rms > demands.rms:
        raise RefusedError(
            f"the points lie {1e3 * found.rms:.3f} mm (rms) off the nominal surface, at most "
            f"{1e3 * demands.rms:.3f} mm is allowed. Is the surface deformed, or the calibration disturbed?"
        )


def _demand_whole(scan: Scan, pose: pin.SE3, nominal: NominalSurface, tolerance: Tolerance, demands: Demands) -> None:
    """Refuse a surface of which too much lies off the nominal one: points that fit elsewhere do not excuse it.

    A robust fit finds the part of a bent or broken surface that agrees with the model, and a pose with it. Medians over
    squares bring to light what the noise of single points hides.
    """
    allowed = departure(tolerance, nominal)
    medians = squares(scan, pose, nominal)
    departed = float(np.mean(np.abs(medians) > allowed)) if len(medians) else 1.0
    if departed > demands.departed:
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


def _demand_agreement(found: Dissent, tolerance: Tolerance, demands: Demands) -> float:
    """Refuse a surface of which a quarter by itself puts the place elsewhere; else how far beyond noise it does."""
    if found.excess > demands.dissent:
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


def departure(tolerance: Tolerance, nominal: NominalSurface) -> float:
    """How far a square of the surface may lie off it, m: no farther than what the tolerances move it by."""
    return min(tolerance.translation / 3, tolerance.rotation * nominal.radius)


def squares(scan: Scan, pose: pin.SE3, nominal: NominalSurface) -> Array:
    """Median distances (k,) in m from the surface over squares of `SQUARE` m that hold enough points."""
    local = (scan.points - pose.translation) @ pose.rotation
    index, feet = nominal.feet(local, 0.006)
    index, heights = index[feet.inner], feet.heights[feet.inner]
    if len(index) == 0:
        return np.empty(0)
    sides = across(nominal)[1]
    cells = np.floor(local[index] @ sides.T / SQUARE).astype(np.intp)
    _, owner, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(owner, kind="stable")
    groups = np.split(heights[order], np.cumsum(count)[:-1])
    return np.array([np.median(group) for group in groups if len(group) >= SQUARE_POINTS])


def _disagreement(shared: Array, prior: Prior, correction: Array) -> float:
    """Squared Mahalanobis distance of the pose found from the prior's; `RefusedError` when they contradict each other.

    A direction that the scan does not determine stays where the board put it and adds nothing.
    """
    distance = float(correction @ np.linalg.solve(prior.covariance + shared, correction))
    if distance > BOARD_DISAGREES:
        raise RefusedError(
            f"scan and board disagree: the surface lies {1e3 * float(np.linalg.norm(correction[:3])):.2f} mm and "
            f"{np.degrees(np.linalg.norm(correction[3:])):.2f} deg from where the board puts it (squared distance "
            f"{distance:.0f} in units of the prior, allowed {BOARD_DISAGREES:.0f}). Was the board or the surface "
            "moved?",
            Measured("surface off where the board puts it", 1e3 * float(np.linalg.norm(correction[:3])), "mm"),
            Measured("and turned", float(np.degrees(np.linalg.norm(correction[3:]))), "deg"),
            Measured("squared distance in units of the prior", distance, most=BOARD_DISAGREES),
        )
    return distance

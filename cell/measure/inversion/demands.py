"""What a scan has to be like for its place pose to be believed: reasons to refuse it, in words and figures.

Each comparison asks whether the figure is good: one that is no number is refused as well.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.measure.inversion.disagreement import Dissent
from cell.measure.inversion.nominal import Array, NominalSurface, Scan
from cell.measure.inversion.observability import Tolerance
from cell.measure.inversion.registration import Prior, Registration, across
from drivers.errors import Measured, RefusedError

BOARD_DISAGREES = 40.0
"""Squared Mahalanobis distance between scan and board from which on they contradict each other (6 degrees of freedom:
five in ten million by chance)."""

SQUARE, SQUARE_POINTS = 0.004, 8
"""Edge of the squares over which distances are taken together, m, and the points that one needs to count. Where a
scan is so wide that they would hold few points, the squares are larger."""


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
    share, most = 100 * departed, 100 * demands.departed
    if not share <= most:
        raise RefusedError(
            f"{share:.0f} % of the scanned area lies more than {1e3 * allowed:.2f} mm off the nominal "
            f"surface, at most {most:.0f} % may. Is the surface deformed, worn "
            "or covered, is it another one, or is the calibration disturbed?",
            Measured(f"area more than {1e3 * allowed:.2f} mm off the surface", share, "%", most=most),
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
    """Median distances (k,) in m from the surface over squares of `SQUARE` m or more that hold enough points."""
    local = (scan.points - pose.translation) @ pose.rotation
    index, feet = nominal.feet(local, 0.006)
    index, heights = index[feet.inner], feet.heights[feet.inner]
    if len(index) == 0:
        return np.empty(0)
    places = local[index] @ across(nominal)[1].T
    edge = max(SQUARE, float(np.sqrt(2 * SQUARE_POINTS * np.prod(np.ptp(places, axis=0)) / len(places))))
    cells = np.floor(places / edge).astype(np.intp)
    _, owner, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    groups = np.split(heights[np.argsort(owner, kind="stable")], np.cumsum(count)[:-1])
    return np.array([np.median(group) for group in groups if len(group) >= SQUARE_POINTS])


def require_board(shared: Array, prior: Prior, correction: Array) -> None:
    """Refuse a pose that contradicts the board, by the squared Mahalanobis distance between the two. A direction that
    the scan does not determine stays where the board put it and adds nothing."""
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

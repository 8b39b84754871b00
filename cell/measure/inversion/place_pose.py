"""From the cloud to the place pose: registration and its whole uncertainty. Reasons to refuse it are in `demands`.

What neighbouring points of a scan are off by together: the drawing's facets, the part's form, a stripe on a slope.

A point's own noise averages out over thousands of them. What a patch of the surface shares does not, and a motion that
one patch tells is known no better than that patch. How much it is, the patches' own mean distances show.

Several sweeps in one scan: the pose of each is off by an error of its own, which is found along with the surface's.

Fitted as if they lay right, two strips side by side turn what their heights differ by into a tilt. But every sweep sees
the same surface, and how much its pose may be off is known: both together tell the errors apart. Least squares with
one more unknown for each of them, known beforehand to its standard deviation (docs/explanation/theory.md, section 8).

Other places at which a scan fits the surface as well: teeth, patterns of holes. An inversion that begins near such a
place ends there, with small residuals and a small sigma, and is wrong. So the scan is laid onto the surface from every
place around the one that was found, and the board has to tell them apart.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion.demands import (
    Demands,
    fit_figures,
    require_agreement,
    require_board,
    require_fit,
    require_whole,
)
from cell.measure.inversion.disagreement import dissent
from cell.measure.inversion.nominal import SIGMA_FLOOR, Array, NominalSurface, Scan, sigmas_along
from cell.measure.inversion.nominal import correspondences as matched
from cell.measure.inversion.observability import FREE, PoseVerdict, Tolerance, determined, judge
from cell.measure.inversion.registration import MOST_SHIFT, Prior, Registration, by_lines, candidates, register
from cell.measure.reconstruction.cloud import Cloud
from drivers.errors import Measured, RefusedError

POINTS = 400
"""Of the scan, that are laid onto the surface."""
MOST_PLACES = 12
OVER = 0.6
"""Share of the points that has to lie over the surface at another place, of those that do at the one that was found."""
AS_WELL = 0.97
"""Share of the points over the surface that fit it there, of those that do here, from which on the scan does not tell
the two apart."""
WITHIN, LEAST_M = 4.0, 5e-5
"""A point fits within so many of its σ, or so near, m."""
TOLD_APART = 25.0
"""By so much more, in squared σ, the board has to be against the other place: 5 σ."""
LEAST_TOLD = 3 * FREE
"""Least information of a motion, in those of a point along its normal, for it to lead to another place."""
APART_M = 1e-3
"""By less at the surface no other place is one of its own."""
STEPS, GATE = 12, 0.002


def require_alone(scan: Scan, pose: pin.SE3, nominal: NominalSurface, prior: Prior, information: Array) -> None:
    """Refuse a place base_from_surface beside which there is another one that scan and board allow as well.

    `information` (6, 6) of the scan on the pose, surface axes: along a motion that it leaves to the board there are no
    separate places. Raises `RefusedError` with the shift and turn to the other place.
    """
    some = scan.thinned(POINTS)
    here = _fitting(pose, some, nominal)
    off = difference(pose, prior.base_from_surface)
    board = prior.information()
    spread = np.sqrt(np.diag(prior.covariance))
    shift = min(float(np.sqrt(TOLD_APART) * spread[:3].max() + np.linalg.norm(off[:3])), MOST_SHIFT)
    turn = float(np.sqrt(TOLD_APART) * spread[3:].max() + np.linalg.norm(off[3:]))
    for start in candidates(pose, some.points, nominal, shift=shift, turn=turn, most=MOST_PLACES):
        other = settled(start, some.points, nominal)
        moved = pose.inverse() * other
        middle = moved.act(nominal.centre) - nominal.centre
        turned = float(np.linalg.norm(pin.log3(moved.rotation)))
        if np.linalg.norm(middle) + turned * nominal.radius < APART_M:
            continue
        away = difference(other, prior.base_from_surface)
        against = float(away @ board @ away - off @ board @ off)
        if against > TOLD_APART or not observable(moved, information, nominal.radius):
            continue
        there = _fitting(other, some, nominal)
        if there[0] < OVER * here[0] or there[1] < AS_WELL * here[1]:
            continue
        x, y, z = 1e3 * middle
        raise RefusedError(
            f"the surface looks the same elsewhere: shifted by ({x:.1f}, {y:.1f}, {z:.1f}) mm and turned by "
            f"{1e3 * turned:.0f} mrad, {100 * there[1]:.0f} % of the scan fit it (here {100 * here[1]:.0f} %), and the "
            f"board speaks against that place by {np.sqrt(max(0.0, against)):.1f} σ only, {np.sqrt(TOLD_APART):.0f} "
            "are needed. Scan also what is there once only, or have the station hold the surface more exactly and "
            "state it (surface.prior_sigma)",
            Measured("board against the other place", float(np.sqrt(max(0.0, against))), "σ", least=TOLD_APART**0.5),
        )


def observable(where: pin.SE3, information: Array, radius: float) -> bool:
    """Whether the scan tells this motion at all, by its `information` (6, 6) in the same axes."""
    length = np.array([1.0] * 3 + [radius] * 3)
    motion = np.concatenate([where.translation, pin.log3(where.rotation)]) * length
    scaled = information / np.outer(length, length)
    return bool(motion @ scaled @ motion > LEAST_TOLD * float(motion @ motion) * np.trace(scaled[:3, :3]))


def settled(pose: pin.SE3, points: Array, nominal: NominalSurface) -> pin.SE3:
    """Point to plane, a few steps; motions that the points (n, 3) leave open stay where they are."""
    for _ in range(STEPS):
        index, feet = nominal.feet((points - pose.translation) @ pose.rotation, GATE)
        keep = feet.inner
        normals = feet.normals[keep] @ pose.rotation.T
        arms = points[index[keep]] - pose.translation
        rows = -np.concatenate([normals, np.cross(arms, normals)], axis=1)
        if len(rows) < len(points) // 8:
            return pose
        damping = 1e-3 * len(rows) * np.diag([1.0] * 3 + [nominal.radius**2] * 3)
        step = -np.linalg.solve(rows.T @ rows + damping, rows.T @ feet.heights[keep])
        pose = perturbed(pose, step)
        if np.abs(step[:3]).max() < 1e-6:
            break
    return pose


def _fitting(pose: pin.SE3, scan: Scan, nominal: NominalSurface) -> tuple[int, float]:
    """How many points lie over the surface, and the share of those that lie on it."""
    rows = matched(pose, scan, nominal, GATE)
    if not len(rows.index):
        return 0, 0.0
    on = np.abs(rows.heights) < np.maximum(WITHIN * sigmas_along(scan, rows), LEAST_M)
    return len(rows.index), float(on.mean())


PATCH_M = 0.004
LEAST_POINTS = 8
"""Of a patch whose mean distance counts."""
FAR = 3.5
"""Robust deviations beyond which a patch is a foreign body, not one of many."""


def shared_by_patches(found: Registration, least: float = SIGMA_FLOOR) -> tuple[float, Array]:
    """One standard deviation, m, of what a patch's points share, and the pose's covariance (6, 6) because of it. It is
    `least`, m, where the patches show no more than that."""
    patch, count = _patches(found)
    weights = 1.0 / found.sigmas**2
    total = np.bincount(patch, weights)
    means, by_noise = np.bincount(patch, weights * found.heights) / total, 1.0 / total
    many = count >= LEAST_POINTS
    sigma = _beyond_noise(means[many], by_noise[many], least)
    follow = np.stack([np.bincount(patch, along) for along in found.follow])
    return sigma, np.asarray(sigma**2 * follow @ follow.T)


def _beyond_noise(means: Array, by_noise: Array, least: float) -> float:
    """What patches with these mean distances, m, deviate by beyond the variances, m², of their points' noise."""
    if not len(means):
        return SIGMA_FLOOR
    near = np.abs(means) <= FAR * 1.4826 * np.median(np.abs(means))
    return float(np.sqrt(max(least**2, np.mean(means[near] ** 2 - by_noise[near]))))


def _patches(found: Registration) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The patch of each accepted point, and how many points each has: a square across the way that the surface faces.
    Not by how high the points lie: a border along the surface would part them by the sign of their noise."""
    turn = found.base_from_surface.rotation
    square = np.floor(found.arms @ turn / PATCH_M).astype(np.intp)
    normals = found.normals @ turn
    axis = np.argmax(np.abs(normals), axis=1)[:, None]
    np.put_along_axis(square, axis, 0, axis=1)
    faces = 2 * axis + (np.take_along_axis(normals, axis, axis=1) > 0)
    _, patch, count = np.unique(np.hstack([square, faces]), axis=0, return_inverse=True, return_counts=True)
    return patch.reshape(-1), count


def balance(found: Registration, scan: Scan, moved: Array, prior: Prior) -> Registration:
    """The registration `found` in `scan`, with the sweeps' own errors told apart from the pose.

    `moved` (n, 3, m): how one standard deviation of each of m independent errors displaces the n used points, m, base
    axes. One step from where the registration has converged. What the errors leave behind in the pose is not part of
    the covariance: as for any displacement of the points, `follow` says it.
    """
    by_pose = np.concatenate([found.normals, np.cross(found.arms, found.normals)], axis=1)
    columns = np.concatenate([by_pose, np.einsum("ni,nim->nm", found.normals, moved)], axis=1)
    weighted = columns / found.sigmas[:, None] ** 2
    known = np.eye(columns.shape[1])
    known[:6, :6] = prior.information()
    towards = np.zeros(len(known))
    towards[:6] = prior.information() @ difference(prior.base_from_surface, found.base_from_surface)
    total = np.linalg.inv(weighted.T @ columns + known)[:6]
    follow = total @ weighted.T
    by_prior = total[:, :6]
    lines = by_lines(follow, scan, found)
    return replace(
        found,
        base_from_surface=perturbed(found.base_from_surface, follow @ found.heights + total @ towards),
        covariance=np.asarray(
            (follow * found.sigmas**2) @ follow.T + by_prior @ known[:6, :6] @ by_prior.T + lines @ lines.T
        ),
        follow=follow,
    )


@dataclass(frozen=True, eq=False)
class PlacePose:
    """Where the surface is, and how well that is known.

    base_from_surface: the pose. random, systematic, covariance (their sum): 6×6 of (translation, rotation) in base axes
    about the surface's origin, m² and rad²; random from the stripe, the rail and the prior, systematic from what the
    caller said of the calibration and from what neighbouring points share.
    verdict: is every direction known well enough; its words are in the surface frame.
    rms: of the accepted points' distances, m; chi2_per_dof: the same in units of their noise; n_points: accepted;
    share: accepted among those over the surface; coverage: share of the surface that was seen.
    parts_differ: how far from this place a quarter of the surface puts it, beyond three sigma, in tolerances.
    correction: (6,) from the board's pose to this one, base axes, m and rad. notes: for people, what is not as usual.
    """

    base_from_surface: pin.SE3
    random: Array
    systematic: Array
    covariance: Array
    verdict: PoseVerdict
    rms: float
    chi2_per_dof: float
    n_points: int
    share: float
    coverage: float
    parts_differ: float
    correction: Array
    notes: tuple[str, ...] = ()

    @property
    def sigma(self) -> Array:
        """Standard deviations (6,): translation in m, rotation in rad, base axes."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "points": self.n_points, "rms_mm": round(1e3 * self.rms, 4), "chi2_per_dof": round(self.chi2_per_dof, 3),
            "share": round(self.share, 4), "coverage": round(self.coverage, 3),
            "parts_differ": round(self.parts_differ, 3),
            "correction_mm": [round(1e3 * float(v), 3) for v in self.correction[:3]],
            "correction_mrad": [round(1e3 * float(v), 3) for v in self.correction[3:]],
            "sigma_mm": [round(1e3 * float(v), 4) for v in self.sigma[:3]],
            "sigma_mrad": [round(1e3 * float(v), 4) for v in self.sigma[3:]], "least_known": self.verdict.worst.words,
            "decided_by_board": list(self.verdict.unseen),
        }  # fmt: skip


Resolve = Callable[[NDArray[np.intp], NDArray[np.intp]], Array]
"""Gives, for points at (line, row), how one standard deviation of each independent calibration parameter moves them:
(n, 3, m) in m, base axes."""


def invert_pose(
    cloud: Cloud, nominal: NominalSurface, prior: Prior, tolerance: Tolerance, *, systematic: Array | None = None,
    calibration: Resolve | None = None, sweeps: Resolve | None = None, demands: Demands | None = None,
    most_points: int = 10_000, partly: bool = False, least_shared: float = SIGMA_FLOOR,
) -> PlacePose:  # fmt: skip
    """The pose of the nominal surface in the arm base, from a cloud in the arm base and the board's pose as prior.

    `systematic` (6×6, base axes) is what the place is off by whether scan or board decides it, such as the arm's error
    as it goes there; `calibration` says how the calibration's uncertainty moves each point, and is propagated through
    the registration; `sweeps` how each sweep's own uncertainty moves its points, which is taken out as far as the
    sweeps tell it. A motion that is not known well enough is left to the verdict with `partly`. Neighbouring points are
    off by `least_shared`, m, together, or by what they show.

    Raises `RefusedError` when the scan does not fit the surface, covers too little of it or contradicts the board, and
    `NotObservable` when three standard deviations exceed `tolerance` in some direction, which is named.
    """
    inversion = _Inversion(Scan.of(cloud, most_points), nominal, prior, tolerance, demands or Demands())
    found, coverage, numbers = inversion.fitted()
    lines, rows = cloud.subsample(most_points)
    displaced = [resolve(lines, rows) for resolve in (calibration, sweeps) if resolve is not None]
    if sweeps is not None:
        found = balance(found, inversion.scan, displaced[-1][found.used], prior)
    pose = found.base_from_surface
    explained = np.concatenate(displaced, axis=2) if displaced else None
    with _shown(pose, *numbers):
        parts = dissent(inversion.scan, pose, nominal, tolerance, explained)
        parts_differ = require_agreement(parts, tolerance, inversion.demands)
    shared = _shared(found, displaced, systematic, least_shared)
    if len(cloud.each_sweep()) == 1:
        # What several sweeps differ by is told apart from the pose already.
        shared = shared + parts.covariance(tolerance)
    with _shown(pose, *numbers):
        require_board(shared, prior, difference(pose, prior.base_from_surface))
        pose, random, verdict = inversion.settled(found, shared)
    with _shown(pose, *numbers):
        if not partly:
            verdict.require()
    return PlacePose(
        base_from_surface=pose, random=np.asarray(random), systematic=np.asarray(shared),
        covariance=np.asarray(random + shared), verdict=verdict, rms=found.rms, chi2_per_dof=found.chi2_per_dof,
        n_points=len(found.used), share=found.share, coverage=coverage, parts_differ=parts_differ,
        correction=difference(pose, prior.base_from_surface),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Inversion:
    """One scan of the surface, what is known of its pose before, and what is asked of the result."""

    scan: Scan
    nominal: NominalSurface
    prior: Prior
    tolerance: Tolerance
    demands: Demands

    def fitted(self) -> tuple[Registration, float, tuple[Measured, ...]]:
        """The surface registered in the scan, how much of it is covered, and the figures that every refusal shows."""
        found = register(self.scan, self.nominal, self.prior)
        pose = found.base_from_surface
        local = (self.scan.points[found.used] - pose.translation) @ pose.rotation
        coverage = self.nominal.coverage(local, 0.0025)
        numbers = fit_figures(coverage, found.share, found.rms, found.chi2_per_dof, self.demands)
        with _shown(pose, *numbers):
            require_fit(found, coverage, self.demands)
            require_whole(self.scan, pose, self.nominal, self.tolerance, self.demands)
        return found, coverage, numbers

    def settled(self, found: Registration, shared: Array) -> tuple[pin.SE3, Array, PoseVerdict]:
        """The pose, gone back to the board's where too few points tell a motion; its own covariance; and its verdict.
        `shared` (6, 6) is the covariance of what all points share, base axes."""
        pose, nominal, prior = found.base_from_surface, self.nominal, self.prior
        turn = np.kron(np.eye(2), pose.rotation.T)
        ways: Array = np.concatenate([found.normals, np.cross(found.arms, found.normals)], axis=1) @ turn.T
        told, pull = determined(ways / found.sigmas[:, None], nominal.radius)
        board = turn @ prior.information() @ turn.T
        require_alone(self.scan, pose, nominal, prior, told)
        # Where only a few points tell a motion, the scan counts as if it told nothing: the board decides.
        known = np.linalg.inv(board + told)
        correction = difference(pose, prior.base_from_surface)
        pose = perturbed(pose, -turn.T @ known @ (np.eye(6) - pull) @ board @ turn @ correction)
        unsure = known - np.linalg.inv(board + turn @ found.scan_information @ turn.T)
        random = found.covariance + turn.T @ unsure @ turn
        verdict = judge(
            turn @ (random + shared) @ turn.T, told, float(1.0 / np.mean(1.0 / found.sigmas**2)),
            points=len(found.used), radius=nominal.radius, tolerance=self.tolerance,
        )  # fmt: skip
        return pose, random, verdict


def _shared(found: Registration, displaced: list[Array], systematic: Array | None, least: float) -> Array:
    """Covariance (6, 6) of what all points share: `systematic`, what displaces them together, and the patches."""
    _, by_patches = shared_by_patches(found, least)
    shared = np.zeros((6, 6)) if systematic is None else systematic
    for moved in displaced:
        by_parameter = found.follow @ np.einsum("ni,nim->nm", found.normals, moved[found.used])
        shared = shared + by_parameter @ by_parameter.T
    return shared + by_patches


@contextmanager
def _shown(pose: pin.SE3, *numbers: Measured) -> Iterator[None]:
    """A refusal in this block also shows the candidate "pose" that was judged, and `numbers`."""
    try:
        yield
    except RefusedError as refused:
        refused.showing(*numbers, seen={"pose": pose})
        raise

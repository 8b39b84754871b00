"""Where the nominal surface lies in the scan: robust point-to-plane Gauss–Newton with the board's pose as a prior.

The prior is anchored: its gradient pulls to the board's pose, so that a direction that the scan does not determine
stays where the board put it (docs/explanation/theory.md, section 8). Correspondences are gated from coarse to fine.
What the uncertainty means for the job is judged in `observability`.

Where the registration may begin: poses across the surface at which the scan lies near it.

A placement surface slides and turns onto a wrong place most easily within its own mean plane. The prior leaves a range
of such shifts and turns; all of them are tried against the coarse distance field, and the best, well apart, returned.
"""

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.base.compiled import compiled_fast
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion.nominal import NominalSurface, Rows, Scan, correspondences, robust_scale, sigmas_along
from drivers.errors import Measured, RefusedError

REACH = 0.0015
"""Distance from which on a point counts nothing, m."""
STEP = 0.001
"""Distance between the shifts that are tried, and of the rim between the turns, m."""
MOST_SHIFT, MOST_TURN = 0.010, float(np.radians(28.0))
WORTH = 0.75
"""Share of the best candidate's score that another needs to be looked at."""


def across(nominal: NominalSurface) -> tuple[Array, Array]:
    """Unit mean normal (3,) of the surface and two axes (2, 3) across it, surface frame."""
    normal = np.average(nominal.normals, axis=0, weights=nominal.areas)
    if np.linalg.norm(normal) < 0.1:  # a closed body has no mean normal
        normal = np.array([0.0, 0.0, 1.0])
    normal = normal / np.linalg.norm(normal)
    return normal, np.asarray(np.linalg.svd(normal[None])[2][1:])


def candidates(
    level: pin.SE3, points: Array, nominal: NominalSurface, shift: float, turn: float, most: int
) -> list[pin.SE3]:
    """At most `most` poses base_from_surface, best first, within `shift` m across and `turn` rad about the mean normal
    of `level`, at which many of `points` (n, 3), arm base, lie near the surface."""
    normal, sides = across(nominal)
    shift, turn = min(shift, MOST_SHIFT), min(turn, MOST_TURN)
    n_shift = int(np.ceil(shift / STEP))
    n_turn = int(np.ceil(turn * nominal.radius / (1.5 * STEP)))
    steps: Array = STEP * np.arange(-n_shift, n_shift + 1, dtype=np.float64)
    angles: Array = (turn / max(1, n_turn)) * np.arange(-n_turn, n_turn + 1, dtype=np.float64)
    local = (points - level.translation) @ level.rotation - nominal.centre
    turns = np.stack([pin.exp3(-angle * normal) for angle in angles])
    grid = nominal.grid
    offset = nominal.centre - grid.low
    scores = _scores(local, turns, steps, sides=sides, offset=offset, cell=grid.cell, distance=grid.distance)
    poses: list[pin.SE3] = []
    best = float(scores.max())
    while len(poses) < most and scores.max() > max(0.0, WORTH * best):
        k, i, j = (int(v) for v in np.unravel_index(np.argmax(scores), scores.shape))
        scores[max(0, k - 2) : k + 3, max(0, i - 3) : i + 4, max(0, j - 3) : j + 4] = -1.0
        moved = pin.SE3(pin.exp3(angles[k] * normal), steps[i] * sides[0] + steps[j] * sides[1])
        pivot = pin.SE3(np.eye(3), nominal.centre)
        poses.append(level * pivot * moved * pivot.inverse())
    return poses


@compiled_fast
def _scores(
    points: Array, turns: Array, steps: Array, sides: Array, offset: Array, cell: float, distance: NDArray[np.float32]
) -> Array:
    """Sum of 1 − (distance/REACH)² over the points that lie within REACH, for each (turn, shift, shift)."""
    scores = np.zeros((len(turns), len(steps), len(steps)))
    a, b, c = distance.shape
    turned = np.empty((len(points), 3))
    shifted = np.empty((2, 3))
    for k in range(len(turns)):
        # In cells: each shift then moves the turned points along the turned axes.
        r = turns[k]
        for i in range(3):
            for n in range(len(points)):
                along = r[i, 0] * points[n, 0] + r[i, 1] * points[n, 1] + r[i, 2] * points[n, 2]
                turned[n, i] = (along + offset[i]) / cell
            for side in range(2):
                along = r[i, 0] * sides[side, 0] + r[i, 1] * sides[side, 1] + r[i, 2] * sides[side, 2]
                shifted[side, i] = along / cell
        for i in range(len(steps)):
            for j in range(len(steps)):
                s0 = steps[i] * shifted[0, 0] + steps[j] * shifted[1, 0]
                s1 = steps[i] * shifted[0, 1] + steps[j] * shifted[1, 1]
                s2 = steps[i] * shifted[0, 2] + steps[j] * shifted[1, 2]
                total = 0.0
                for n in range(len(points)):
                    x, y, z = turned[n, 0] - s0, turned[n, 1] - s1, turned[n, 2] - s2
                    if x >= 0 and y >= 0 and z >= 0 and x < a and y < b and z < c:
                        d = distance[int(x), int(y), int(z)]
                        if d < REACH:
                            total += 1.0 - (d / REACH) ** 2
                scores[k, i, j] = total
    return scores


COARSE_POINTS = 1200
"""Points of the search from the start, and of the searches from other starts."""
OTHER_POINTS = 400
FINE_GATE = 0.0005
"""Correspondences farther than this are not used once the pose is nearly found, m."""
CHI_GATE = 3.5
"""A point is accepted within so many standard deviations of the surface."""
MOST_CANDIDATES = 6
SEARCH_GATE = 0.003
"""How far points may lie from the surface at a pose that the search proposes, m."""
POLISHED = 3
"""How many of the poses found are looked at with more points."""
LIKELY = 0.35
"""Share of the scan on the surface from which on a pose is believed to be near the right one; below it, the search
begins anew from other starts."""
OTHER_START = (0.006, float(np.radians(12.0)))
"""How far the other starts lie from the given one: height (m) and tilt (rad)."""
WELL_LEVELLED = float(np.radians(3.0))
"""A start turned by less than this against the pose found, rad, need not be searched from twice."""
FLOORS = (1e-4, 5e-5, 2e-5, 1e-5, 0.0, 0.0, 0.0)
"""What is added to the points' deviations in the steps from the coarse pose to the fine one, m."""
LEAST_POINTS = 100


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the scan: base_from_surface and its 6×6 covariance (translation, rotation; base axes)."""

    base_from_surface: pin.SE3
    covariance: Array

    def information(self) -> Array:
        """Inverse of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance))


@dataclass(frozen=True, eq=False)
class Registration:
    """The pose found. All 6×6 matrices are of (translation, rotation) in base axes, about the surface's origin.

    base_from_surface: the pose; scan_information: what the scan alone says, from stripe noise; covariance: random part,
    scan and prior together; follow: (6, m) how the pose follows each accepted point along its normal.
    used: indices of the accepted points of the scan; heights: their distances from the surface (m);
    normals, arms: (m, 3) their normals and places relative to the surface's origin, in base axes; sigmas: m.
    share: accepted points among those over the surface.
    """

    base_from_surface: pin.SE3
    scan_information: Array
    covariance: Array
    follow: Array
    used: NDArray[np.intp]
    heights: Array
    normals: Array
    arms: Array
    sigmas: Array
    share: float

    @property
    def rms(self) -> float:
        """Root mean square of the accepted points' distances from the surface, m."""
        return float(np.sqrt(np.mean(self.heights**2)))

    @property
    def chi2_per_dof(self) -> float:
        """Mean square of the distances in units of their standard deviation."""
        return float(np.sum((self.heights / self.sigmas) ** 2) / max(1, len(self.heights) - 6))


def register(scan: Scan, nominal: NominalSurface, prior: Prior) -> Registration:
    """Find base_from_surface from the prior's pose on, in the light of scan and prior. Raises `RefusedError` when too
    few points lie over the surface."""
    begin = prior.base_from_surface
    pose, fit = _search(begin, scan, nominal, prior, begin)
    for other in _beside(begin, nominal, prior):
        if fit >= LIKELY:
            break
        pose, fit = max((pose, fit), _search(other, scan, nominal, prior, begin), key=lambda each: each[1])
    if np.linalg.norm(pin.log3(begin.rotation.T @ pose.rotation)) > WELL_LEVELLED:
        # The search across the surface saw it tilted; from the pose found it sees it as it lies.
        pose, fit = max((pose, fit), _search(pose, scan, nominal, prior, begin), key=lambda each: each[1])
    return _fine(pose, scan, nominal, prior)


def _search(
    attempt: pin.SE3, scan: Scan, nominal: NominalSurface, prior: Prior, begin: pin.SE3
) -> tuple[pin.SE3, float]:
    """The best pose found from `attempt`, and how well it fits. How far to look follows from `begin`, the start."""
    thin, sparse = scan.thinned(COARSE_POINTS), scan.thinned(OTHER_POINTS)
    spread = _prior_spread(prior, begin)
    first = float(np.clip(spread[0] + nominal.radius * spread[1], 0.002, 0.5 * nominal.radius))
    tried = [_tried(_coarse(attempt, sparse, nominal, prior, first), thin, nominal)]
    level = _levelled(attempt, sparse, nominal, first)
    for candidate in candidates(level, sparse.points, nominal, *spread, MOST_CANDIDATES):
        tried.append(_tried(_coarse(candidate, sparse, nominal, prior, SEARCH_GATE), thin, nominal))
    tried.sort(key=lambda each: -each[1])
    # Few points see little of an edge: more of them settle which pose is best, and bring it where the last steps hold.
    polished = [_coarse(pose, thin, nominal, prior, 2 * FINE_GATE) for pose, _ in tried[:POLISHED]]
    return max((_tried(pose, thin, nominal) for pose in polished), key=lambda each: each[1])


def _beside(begin: pin.SE3, nominal: NominalSurface, prior: Prior) -> list[pin.SE3]:
    """Other starts: raised, lowered and tilted either way, where the prior leaves it open."""
    normal, sides = across(nominal)
    shift, turn = _prior_spread(prior, begin)
    pivot = pin.SE3(np.eye(3), nominal.centre)
    ways = [pin.SE3(np.eye(3), sign * min(shift, OTHER_START[0]) * normal) for sign in (1.0, -1.0)]
    tilts = [sign * min(turn, OTHER_START[1]) * side for side in sides for sign in (1.0, -1.0)]
    ways += [pin.SE3(pin.exp3(tilt), np.zeros(3)) for tilt in tilts]
    return [begin * pivot * way * pivot.inverse() for way in ways]


def _tried(pose: pin.SE3, scan: Scan, nominal: NominalSurface) -> tuple[pin.SE3, float]:
    return pose, _fit(pose, scan, nominal)


def _prior_spread(prior: Prior, start: pin.SE3) -> tuple[float, float]:
    """How far across the surface (m) and about its normal (rad) it may lie from the start: three σ of the prior."""
    sigma = np.sqrt(np.diag(prior.covariance))
    off = difference(start, prior.base_from_surface)
    shift = 3 * float(sigma[:3].max()) + float(np.linalg.norm(off[:3]))
    return shift, 3 * float(sigma[3:].max()) + float(np.linalg.norm(off[3:]))


def _levelled(pose: pin.SE3, scan: Scan, nominal: NominalSurface, first: float) -> pin.SE3:
    """The pose with its height and its two tilts, but not its place across the surface, brought to the scan."""
    normal, sides = across(nominal)
    gate = first
    while gate > 0.001:
        for _ in range(4):
            rows = correspondences(pose, scan, nominal, gate)
            if len(rows.index) < LEAST_POINTS / 2:
                break
            turn = pose.rotation
            about = turn @ nominal.centre
            ways = np.zeros((6, 3))
            ways[:3, 0] = turn @ normal
            ways[3:, 1:] = (turn @ sides.T) / nominal.radius
            # Tilts about the middle of the surface: they move its origin.
            ways[:3, 1:] = -np.cross(ways[3:, 1:].T, about).T
            jacobian = rows.jacobian @ ways
            scale = gate / 2.5
            weights = (scale**2 / (scale**2 + rows.heights**2)) ** 2
            weighted = jacobian * weights[:, None]
            hessian = weighted.T @ jacobian + 1e-6 * len(rows.index) * np.eye(3)
            step = -np.linalg.solve(hessian, weighted.T @ rows.heights)
            pose = perturbed(pose, ways @ step)
            if np.abs(step).max() < 0.03 * gate:
                break
        gate *= 0.5
    return pose


def _coarse(pose: pin.SE3, scan: Scan, nominal: NominalSurface, prior: Prior, first: float) -> pin.SE3:
    """Gauss–Newton while the gate shrinks by half from `first`, with a weight that falls off with the distance."""
    gate = first
    while gate > 0.6 * FINE_GATE:
        scale = gate / 2.5
        for _ in range(4):
            rows = correspondences(pose, scan, nominal, gate)
            if len(rows.index) < LEAST_POINTS / 2:
                break
            weights = (scale**2 / (scale**2 + rows.heights**2)) ** 2 / (0.5 * scale) ** 2
            pose, step = _update(pose, rows, weights, prior)
            if step < 0.03 * gate:
                break
        gate *= 0.5
    return pose


def _fit(pose: pin.SE3, scan: Scan, nominal: NominalSurface) -> float:
    """How well a pose explains the scan: share of all points that lie on the surface to within their noise."""
    rows = correspondences(pose, scan, nominal, 0.003)
    if len(rows.index) < LEAST_POINTS / 2:
        return 0.0
    fitting = np.abs(rows.heights) < np.maximum(4 * sigmas_along(scan, rows), 1e-4)
    return float(fitting.sum() / len(scan.points))


def _fine(pose: pin.SE3, scan: Scan, nominal: NominalSurface, prior: Prior) -> Registration:
    """All points: first with a weight that rejects far ones, then with those that pass the χ² gate.

    Points on an upright wall are known to micrometres along its normal, the coarse pose is not: with less than `FLOORS`
    they would all be rejected, and the prior alone would say where the surface lies along that normal.
    """
    for floor in FLOORS:
        rows = correspondences(pose, scan, nominal, FINE_GATE)
        _require_points(rows, scan)
        sigmas = np.hypot(sigmas_along(scan, rows), floor)
        ratio = rows.heights / (4.7 * robust_scale(rows.heights / sigmas) * sigmas)
        pose, step = _update(pose, rows, np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0) / sigmas**2, prior)
        if step < 2e-7:
            break
    for _ in range(8):
        rows = correspondences(pose, scan, nominal, FINE_GATE)
        sigmas = sigmas_along(scan, rows)
        scale = robust_scale(rows.heights / sigmas)
        accepted = np.abs(rows.heights) < CHI_GATE * scale * sigmas
        # Where the fit is worse than the noise says, the scan is believed less.
        pose, step = _update(pose, rows, accepted / (scale * sigmas) ** 2, prior)
        if step < 2e-8:
            break
    rows = correspondences(pose, scan, nominal, FINE_GATE)
    _require_points(rows, scan)
    sigmas = sigmas_along(scan, rows)
    scale = robust_scale(rows.heights / sigmas)
    return _result(pose, scan, nominal, prior=prior, rows=rows, sigmas=sigmas * scale, gate=CHI_GATE)


def _result(
    pose: pin.SE3, scan: Scan, nominal: NominalSurface, prior: Prior, rows: Rows, sigmas: Array, gate: float
) -> Registration:
    """Collect the outcome and propagate the noise: each point's own, and the rail's, common to a line."""
    keep = np.flatnonzero(np.abs(rows.heights) < gate * sigmas)
    weighted = rows.jacobian[keep] / sigmas[keep, None] ** 2
    information = weighted.T @ rows.jacobian[keep]
    total = np.linalg.inv(information + prior.information())
    over = correspondences(pose, scan, nominal, 0.003)
    found = Registration(
        base_from_surface=pose, scan_information=information, covariance=np.asarray(total, dtype=np.float64),
        follow=-total @ weighted.T, used=rows.index[keep], heights=rows.heights[keep], normals=rows.normals[keep],
        arms=rows.arms[keep], sigmas=sigmas[keep], share=len(keep) / max(1, len(over.index)),
    )  # fmt: skip
    lines = by_lines(found.follow, scan, found)
    return replace(found, covariance=found.covariance + lines @ lines.T)


def by_lines(follow: Array, scan: Scan, found: Registration) -> Array:
    """(6, l) motion of the pose by one standard deviation of the rail's error of each of the l lines."""
    along = np.einsum("ni,ni->n", scan.rail_spread[found.used], found.normals)
    _, line = np.unique(scan.lines[found.used], return_inverse=True)
    made = np.zeros((int(line.max()) + 1, 6))
    np.add.at(made, line, (follow * along).T)
    return made.T


def _update(pose: pin.SE3, rows: Rows, weights: Array, prior: Prior) -> tuple[pin.SE3, float]:
    """One Gauss–Newton step with weights 1/σ²; also the largest displacement at the surface that it makes, m."""
    off = difference(pose, prior.base_from_surface)
    by_pose = np.eye(6)
    by_pose[3:, 3:] = pin.Jlog3(pin.exp3(off[3:])).T
    anchored = by_pose.T @ prior.information()
    weighted = rows.jacobian * weights[:, None]
    hessian = weighted.T @ rows.jacobian + anchored @ by_pose
    step = -np.linalg.solve(hessian, weighted.T @ rows.heights + anchored @ off)
    reach = float(np.abs(rows.arms).max()) if len(rows.arms) else 0.0
    return perturbed(pose, step), float(np.abs(step[:3]).max() + np.abs(step[3:]).max() * reach)


def _require_points(rows: Rows, scan: Scan) -> None:
    if len(rows.index) < LEAST_POINTS:
        raise RefusedError(
            f"{len(rows.index)} of {len(scan.points)} scanned points lie within {1e3 * FINE_GATE:.1f} mm of the "
            f"nominal surface, at least {LEAST_POINTS} are needed. Is it the right surface, and is the scan over it?",
            Measured("points near the nominal surface", len(rows.index), least=LEAST_POINTS),
        )

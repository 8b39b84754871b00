"""Other places at which the sweeps would fit the surface as well: teeth, patterns of holes, little that tells.

An inversion that begins near such a place ends there, with small residuals and a small sigma, and is wrong. So the
points that the sweeps will see are laid onto the surface from every place that the board leaves open.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cell.apps.new_job.rays import Array
from cell.apps.new_job.sweeps import SeenSurface
from cell.config.job import Job
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.alternative_poses import settled, told
from cell.measure.inversion.start_poses import MOST_SHIFT, candidates

POINTS = 600
"""Of the sweeps, that are laid onto the surface."""
MOST_PLACES = 24
FITS, ON = 0.98, 1e-4
"""Share of the points that lie this near, m, to the surface at a place that cannot be told from the true one."""
OVER = 0.6
"""Share of the points that has to lie over the surface there at all, as a job demands it."""
GATE = 0.002


def rivals(seen: Sequence[SeenSurface], nominal: NominalSurface, job: Job) -> list[tuple[Array, float]]:
    """Shifts (3,) m of the surface's middle, and turns, rad, of other places that fit as well, the nearest first.

    Looked for within six standard deviations of the prior, at most 10 mm across: the surface may lie at one end of the
    three that a job searches, and seem to lie at the other.
    """
    points = np.concatenate([each.points[each.solid] for each in seen])
    if len(points) < POINTS // 4:
        return []
    points = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
    shift, turn = min(6 * job.surface.prior_sigma, MOST_SHIFT), 6 * job.surface.prior_sigma_angle
    information = sum((each.information(each.solid) for each in seen), np.zeros((6, 6)))
    found: list[tuple[Array, float]] = []
    for start in candidates(pin.SE3.Identity(), points, nominal, shift=shift, turn=turn, most=MOST_PLACES):
        where = settled(start, points, nominal)
        turned = float(np.linalg.norm(pin.log3(where.rotation)))
        middle = where.act(nominal.centre) - nominal.centre
        same = np.linalg.norm(middle) < job.place.tolerance and turned < job.place.tolerance_angle
        near = np.linalg.norm(middle) <= np.sqrt(2) * shift and turned <= turn
        if near and not same and told(where, information, nominal.radius) and _fit(where, points, nominal) > FITS:
            found.append((np.asarray(middle), turned))
    return sorted(found, key=lambda each: float(np.linalg.norm(each[0])))


def _fit(pose: pin.SE3, points: Array, nominal: NominalSurface) -> float:
    """Share of the points over the surface that lie on it; 0 where too few are over it."""
    local = (points - pose.translation) @ pose.rotation
    _, feet = nominal.feet(local, GATE)
    over = feet.inner
    if over.sum() < OVER * len(points):
        return 0.0
    return float((np.abs(feet.heights[over]) < ON).mean())

"""Whether the planned sweeps tell where the surface is, before anything is swept; and which motion they leave open.

The same inversion that a job does, on the points that the sweeps will see of the drawn surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cell.apps.new_job.rays import Array
from cell.apps.new_job.sweeps import SeenSurface, as_cloud
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.measure.inversion import NominalSurface, PlacePose, Prior, Tolerance, invert_pose
from cell.measure.inversion.observability import FREE, PoseVerdict, judge
from cell.measure.reconstruction import flange_motions

OVER = 1e-4
"""How far points of the drawing may lie from the surface that was cut out of it, m."""
FEW = 0.03
"""Share of the points that has to tell a shift: with less, on upright faces, true errors of six sigma were seen."""
BARELY = 1.5
"""So many times what the inversion takes for no information counts as none here: a scan may bring less than drawn."""


def prior_of(job: Job) -> Array:
    """Covariance (6, 6) of where the board puts the surface, S, m² and rad²."""
    surface = job.surface
    return np.diag([surface.prior_sigma**2] * 3 + [surface.prior_sigma_angle**2] * 3)


def shared_by_all(config: CellConfig) -> Array:
    """Covariance (6, 6) of what all points have in common: the arm's geometry as configured, m² and rad²."""
    arm = config.arm
    return np.diag([arm.kinematic_sigma**2] * 3 + [arm.kinematic_sigma_angle**2] * 3)


def verdict(information: Array, points: int, radius: float, job: Job, config: CellConfig) -> PoseVerdict:
    """What a scan of this information (6, 6) in `points` points leaves open. A motion that the scan hardly determines
    is left to the board altogether: what there is of it may be noise, or the drawing's facets."""
    length = np.array([1.0] * 3 + [radius] * 3)
    variance = points / max(float(np.trace(information[:3, :3])), 1e-9)
    spectrum, ways = np.linalg.eigh(information / np.outer(length, length))
    spectrum = np.where(spectrum * variance / points < BARELY * FREE, 0.0, spectrum)
    information = (ways * spectrum) @ ways.T * np.outer(length, length)
    known = np.linalg.inv(information + np.linalg.inv(prior_of(job)))
    gain = known @ information
    covariance = known + gain @ shared_by_all(config) @ gain.T
    return judge(covariance, information, variance, points=points, radius=radius, tolerance=_tolerance(job))


def known(seen: Sequence[SeenSurface], surface: NominalSurface, job: Job, config: CellConfig) -> PoseVerdict:
    """What these sweeps leave open, by the points that the inversion uses: those over `surface`, not at its borders."""
    used = [each.valid for each in seen]
    for mask, each in zip(used, seen, strict=True):
        index, feet = surface.feet(each.points[mask], OVER)
        over = np.zeros(int(mask.sum()), dtype=np.bool_)
        over[index] = feet.inner
        mask[mask] = over
    information = sum((each.information(mask) for each, mask in zip(seen, used, strict=True)), np.zeros((6, 6)))
    return verdict(information, sum(int(mask.sum()) for mask in used), surface.radius, job, config)


def told_by_few(seen: Sequence[SeenSurface], surface: NominalSurface) -> list[str]:
    """A line for x and for y where few points alone tell how the surface lies along it: those on upright faces."""
    points = np.concatenate([each.points[each.valid] for each in seen])
    normals = np.concatenate([each.normals[each.valid] for each in seen])
    index, feet = surface.feet(points, OVER)
    notes = []
    for k, axis in enumerate("xy"):
        weights = normals[index[feet.inner], k] ** 2
        share = float(weights.sum() ** 2 / max(1e-12, len(weights) * float((weights**2).sum())))
        if share < FEW:
            notes.append(
                f"how the surface lies along {axis} is told by {100 * share:.1f} % of the points alone, upright ones "
                f"(relief: {100 * FEW:g} % or more): the stated error may be too small there; prefer a side with relief"
            )
    return notes


def place_from(seen: Sequence[SeenSurface], nominal: NominalSurface, job: Job, config: CellConfig) -> PlacePose:
    """The place as the job's own inversion would tell it from these sweeps, without noise.

    Raises `NotObservable` that names the motion which surface and sweeps leave open, `RefusedError` when they cover
    too little of the surface.
    """
    cloud = as_cloud(list(seen), config.calibration.rail_sigma).require()
    arm = config.arm
    rest = np.diag([arm.repeatability**2] * 3 + [arm.repeatability_angle**2] * 3)
    return invert_pose(
        cloud,
        nominal,
        Prior(pin.SE3.Identity(), prior_of(job)),
        _tolerance(job),
        systematic=shared_by_all(config),
        sweeps=lambda lines, rows: flange_motions(cloud, lines, rows, [rest] * len(seen)),
    )


def _tolerance(job: Job) -> Tolerance:
    return Tolerance(job.place.tolerance, job.place.tolerance_angle)

"""What a place pose's stated uncertainty means at the part: the error below which 95 % of its points are to end.

For a cell whose truth nobody knows this is the figure to hold against the job's tolerance; on a simulated cell it
stands beside the true error.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin
import scipy

from cell.config.job import Job
from cell.measure.geometry.poses import composition_jacobians, transform
from cell.measure.inversion import NominalSurface, PlacePose
from drivers.interfaces import Vector

SEGMENTS, POINTS_PER_SEGMENT = 5, 9
DRAWS = 2000
POSE_DRAWS = 20_000


@lru_cache(maxsize=4)
def part_points(nominal: NominalSurface) -> Vector:
    """The 45 points (45, 3) in m on the mating face, part frame: 5 segments along x of 9 points each. Not to be written
    to: a report asks for the same surface's points several times."""
    low, high = nominal.vertices[:, :2].min(axis=0), nominal.vertices[:, :2].max(axis=0)
    count = SEGMENTS * POINTS_PER_SEGMENT
    along = low[0] + (high[0] - low[0]) * (np.arange(count) + 0.5) / count
    across = np.tile(
        np.linspace(0.9 * low[1] + 0.1 * high[1], 0.1 * low[1] + 0.9 * high[1], POINTS_PER_SEGMENT), SEGMENTS
    )
    _, nearest = scipy.spatial.cKDTree(nominal.samples[:, :2]).query(np.column_stack([along, across]))
    points: Vector = nominal.samples[nearest]
    points.flags.writeable = False
    return points


def stated_bound(
    job: Job, nominal: NominalSurface, pose: PlacePose, placing: Vector, grasp: Vector | None = None
) -> dict[str, object]:
    """Bounds in mm that hold for 95 % of the part's 45 points, by axis of the surface's frame and for D.

    From the pose's own covariance, from `placing`, the (6, 6) covariance of the flange each time the arm comes to
    rest, and from `grasp`, the (6, 6) covariance of the part in the claw about the part's origin; without it the part
    is taken to be held exactly as configured.
    """
    covariances = point_covariances(job, nominal, pose, pose.covariance, placing)
    if grasp is not None:
        points, _ = placed_points(job, nominal, pose)
        part = transform(pose.base_from_surface, job.place.surface_from_part.se3().translation[None])
        covariances = covariances + through(points - part, grasp)
    turn = pose.base_from_surface.rotation
    errors = 1e3 * np.abs(draws(turn.T @ covariances @ turn))
    distance = np.linalg.norm(errors, axis=-1)
    by_axis = {name: float(np.percentile(errors[..., k], 95)) for k, name in enumerate("xyz")}
    return {"frame": "surface", "unit": "mm", **by_axis, "d": float(np.percentile(distance, 95))}


def point_covariances(job: Job, nominal: NominalSurface, pose: PlacePose, of_pose: Vector, placing: Vector) -> Vector:
    """Covariances (45, 3, 3), m², base axes, of where the part's points end. `of_pose` (6, 6) is that of the surface's
    pose, `placing` (6, 6) that of the flange as it lets go."""
    points, place_flange = placed_points(job, nominal, pose)
    covariance = through(points - pose.base_from_surface.translation, of_pose)
    return covariance + through(points - place_flange.translation, placing)


def part_covariance(job: Job, pose: PlacePose, placing: Vector) -> Vector:
    """Covariance (6, 6), m² and rad², surface axes, of surface_from_part as it ends, about the part's origin. Of the
    pose, of the flange as it lets go (`placing`, (6, 6), base axes) and of the grasp."""
    base_from_part = pose.base_from_surface * job.place.surface_from_part.se3()
    place_flange = base_from_part * job.grasp.flange_from_part.se3().inverse()
    made = job.grasp.covariance
    for origin, covariance in ((pose.base_from_surface, pose.covariance), (place_flange, placing)):
        carried = composition_jacobians(origin, origin.inverse() * base_from_part)[0]
        made = made + carried @ covariance @ carried.T
    turn = np.kron(np.eye(2), pose.base_from_surface.rotation.T)
    return np.asarray(turn @ made @ turn.T)


def placed_points(job: Job, nominal: NominalSurface, pose: PlacePose) -> tuple[Vector, pin.SE3]:
    """Where the part's 45 points (45, 3), m, and the flange are in the base when the part lies where it belongs."""
    base_from_part = pose.base_from_surface * job.place.surface_from_part.se3()
    return transform(base_from_part, part_points(nominal)), base_from_part * job.grasp.flange_from_part.se3().inverse()


def through(arms: Vector, covariance: Vector) -> Vector:
    """Covariances (n, 3, 3) of points at `arms` (n, 3) from the origin of a pose of covariance (6, 6)."""
    jacobians = np.stack([np.hstack([np.eye(3), -pin.skew(arm)]) for arm in arms])
    return np.asarray(jacobians @ covariance @ jacobians.transpose(0, 2, 1), dtype=np.float64)


def draws_of(covariance: Vector) -> Vector:
    """Motions (20000, 6) drawn with a pose's covariance (6, 6), always the same ones."""
    values, ways = np.linalg.eigh(covariance)
    return np.asarray(
        np.random.default_rng(0).standard_normal((POSE_DRAWS, 6)) @ (ways * np.sqrt(np.maximum(values, 0.0))).T
    )


def draws(covariances: Vector) -> Vector:
    """Errors (2000, n, 3) drawn with covariances (n, 3, 3), always the same ones."""
    values, vectors = np.linalg.eigh(covariances)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    normal = np.random.default_rng(0).standard_normal((DRAWS, 1, 3, 1))
    return np.asarray((roots @ normal)[..., 0], dtype=np.float64)

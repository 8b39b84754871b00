"""The simulated world's truth, asked for by the report alone: no step has a way to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from cell.config.job import Job
from cell.measure.geometry.poses import difference, from_matrix, transform
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.reconstruction import Cloud
from cell.procedures.part_error import draws, part_points, placed_points, point_covariances, through
from drivers.interfaces import Vector
from statemachine.runner import Event

SENSOR_POINTS = 1000


class TruthRecorder:
    """Listens to a run and notes the truth right after the sweep, when the scanned surface was where it was scanned."""

    def __init__(self, ask: Callable[[], dict[str, Any]]) -> None:
        """`ask()` gives the whole truth; see `sim_backends.world.world`."""
        self.ask = ask
        self.at_sweep: dict[str, object] | None = None

    def __call__(self, event: Event) -> None:
        """Take an event of the runner."""
        if event.kind == "step_done" and event.step == "laser_sweep":
            self.at_sweep = self.ask()


def pose_of(truth: dict[str, Any], name: str) -> pin.SE3:
    """A pose of the truth by its name."""
    return from_matrix(truth["poses"][name])


def pose_error(pose: PlacePose, truth: dict[str, object]) -> dict[str, object]:
    """How far the inverted pose of the surface is from the true one at the sweep, arm base axes; also when refused."""
    error = difference(pose.base_from_surface, pose_of(truth, "base_from_surface"))
    return {
        "translation_mm": [round(1e3 * float(v), 4) for v in error[:3]],
        "rotation_mrad": [round(1e3 * float(v), 4) for v in error[3:]],
    }


def sensor_error(cloud: Cloud, nominal: NominalSurface, truth: dict[str, object]) -> dict[str, float] | None:
    """Distance of 1000 cloud points from the true surface, the arm's and the hand-eye's error included; mm."""
    lines, rows = cloud.valid.nonzero()
    points = transform(pose_of(truth, "base_from_surface").inverse(), cloud.points[lines, rows])
    deviations = nominal.deviations(points)
    deviations = deviations[np.isfinite(deviations)]
    if len(deviations) < SENSOR_POINTS:
        return None
    distance = 1e3 * np.abs(deviations[np.linspace(0, len(deviations) - 1, SENSOR_POINTS).astype(int)])
    return {"mean": float(distance.mean()), "p85": float(np.percentile(distance, 85))}


def place_error(job: Job, nominal: NominalSurface, truth: dict[str, object]) -> dict[str, object]:
    """How far the part's 45 points ended from where they belong on the true surface, in the surface's axes, mm."""
    points = part_points(nominal)
    ended = transform(pose_of(truth, "surface_from_part"), points)
    error = 1e3 * (ended - transform(job.place.surface_from_part.se3(), points))
    distance = np.linalg.norm(error, axis=1)
    columns = {"x": np.abs(error[:, 0]), "y": np.abs(error[:, 1]), "z": np.abs(error[:, 2]), "d": distance}
    return {
        "points": len(points),
        "error_mm": {name: {"mean": float(v.mean()), "max": float(v.max())} for name, v in columns.items()},
        "d_p95": float(np.percentile(distance, 95)),
    }


def expected_error(
    job: Job,
    nominal: NominalSurface,
    pose: PlacePose,
    base_from_sweep_flange: pin.SE3,
    sweeps: int,
    configured: Vector,
    truth: dict[str, Any],
) -> float:
    """Mean D in mm over the 45 points to expect from the world's assumed noise.

    Stripe, rail and calibration as the pose's covariance states them; the arm's repeatability, once for each of the
    `sweeps`, whose mean counts, and once for placing, as the world assumes it instead of the `configured` (6, 6) that
    the covariance was stated with. The arm's kinematic error is in it as configured, which is part of the pose's
    covariance.
    """
    sigma = {
        name: truth["assumed_noise"][name]["sigma"] for name in ("arm_repeatability", "arm_repeatability_rotation")
    }
    radial, angle = sigma["arm_repeatability"], sigma["arm_repeatability_rotation"]
    assumed = np.diag([radial**2 / 3] * 3 + [angle**2] * 3)
    points, _ = placed_points(job, nominal, pose)
    covariance = point_covariances(job, nominal, pose, pose.covariance, assumed)
    covariance = covariance + through(points - base_from_sweep_flange.translation, (assumed - configured) / sweeps)
    return float(1e3 * np.linalg.norm(draws(covariance), axis=-1).mean())

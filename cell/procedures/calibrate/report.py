"""How good a calibration is, beyond its χ²: coverage, residuals, what limits it at the job's points, what to add.

Made from the adjustments and the observations, so it serves a calibration just made and an archived one alike. A run
never asks for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cell.config.calibrations.store import Solved
from cell.config.cell_config import CellConfig
from cell.config.job import Job, load_job
from cell.measure.calibration.archive import Observations
from cell.measure.calibration.judge.advice import advice
from cell.measure.calibration.judge.coverage import Coverage
from cell.measure.calibration.judge.influence import Places, derivatives, influences, place_rms
from cell.measure.calibration.judge.joint_checks import joint_checks
from cell.measure.calibration.solve.joint import Joint, paper_plane_of
from cell.measure.calibration.solve.results import ScanCalibration
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.camera_poses import base_from_place_at_target, scan_plans
from cell.procedures.calibrate.pictures import camera_picture, influence_picture
from cell.procedures.part_error import part_points


@dataclass(frozen=True, eq=False)
class Examination:
    """The figures as JSON has them, and what the pictures are drawn from."""

    summary: dict[str, Any]
    scan: Coverage
    target: Coverage

    def draw(self, folder: Path) -> list[Path]:
        """Draw the pictures into a folder, which is made; their paths."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{name}.png" for name in ("scan_camera", "target_camera", "place_error")]
        camera_picture(paths[0], self.scan, "scan camera")
        camera_picture(paths[1], self.target, "target camera")
        influence_picture(paths[2], self.summary["influence"], self.summary["advice"])
        return paths


def examine(solved: Solved, observations: Observations, config: CellConfig, job: str | Path) -> Examination:
    """Coverage and residuals of both cameras; what limits the 45 points of a job, and what would better them."""
    loaded, mesh = load_job(job)
    nominal = NominalSurface.load(mesh, unit=loaded.surface.mesh_unit)
    places = places_of_job(config, loaded, nominal, solved.calibration.scan)
    adjusted = solved.scan.adjusted
    state, covariance = adjusted.state, adjusted.reliable_covariance
    by_parameter = derivatives(state, covariance, places)
    board = next(o.view.spec for o in observations.scan if o.view is not None)
    scan, target = Coverage.of(solved.scan), Coverage.of(solved.target)
    summary = {
        "scan_coverage": scan.summary(),
        "target_coverage": target.summary(),
        "noise_found": noise_found(solved.scan),
        "paper_steps": paper_check(solved.scan, observations),
        "checks": [
            {"camera": camera, **check.as_dict()}
            for camera, joint, nominal in (
                ("scan", solved.scan, observations.scan_camera),
                ("target", solved.target, observations.target_camera),
            )
            for check in joint_checks(joint, nominal)
        ],
        "influence": influences(by_parameter, covariance),
        "advice": advice(
            solved.scan, board, config.rail.travel, lambda other: place_rms(by_parameter, np.asarray(other))
        ),
    }
    return Examination(summary, scan, target)


def places_of_job(config: CellConfig, job: Job, nominal: NominalSurface, scan: ScanCalibration) -> Places:
    """The job's 45 points as the sweep sees them when vehicle, board and surface are where they should be."""
    base_from_surface = base_from_place_at_target(config, job) * job.surface.place_from_surface.se3()
    plan = scan_plans(config, job, base_from_surface, scan)[0]
    in_base = transform(base_from_surface, transform(job.place.surface_from_part.se3(), part_points(nominal)))
    in_flange = transform(plan.base_from_flange.inverse(), in_base)
    at_home = transform(scan.flange_from_camera.inverse(), in_flange)
    # The carriage stands where the light plane goes through the point.
    normal = scan.light_plane.n
    rails = (at_home @ normal - scan.light_plane.distance) / float(scan.rail_direction @ normal)
    return Places(scan.camera.project(at_home - rails[:, None] * scan.rail_direction), rails, plan.base_from_flange)


def noise_found(joint: Joint) -> dict[str, float]:
    """The noise that the residuals speak of, as multiples of what dots and stripe state, and χ²/dof."""
    priors = joint.adjusted.priors
    return {
        "dots": priors.dots_scale,
        "stripe": priors.stripe_scale,
        "chi2_per_dof": joint.adjusted.chi2_per_dof,
    }


def paper_check(joint: Joint, observations: Observations) -> dict[str, Any] | None:
    """The light plane by the paper's six steps, with the adjusted camera and boards, beside the adjusted plane.

    `apart_mrad` between the normals, `apart_mm` between the planes at the middle of the stripe's points; None where the
    stripe crosses too few rows.
    """
    state, staged = joint.adjusted.state, joint.staged
    if state.plane is None or staged.plane is None:
        return None
    poses = [
        state.camera_from_board(flange, rail) for flange, rail in zip(state.flanges, state.rails.tolist(), strict=True)
    ]
    paper = paper_plane_of(state.camera, poses, observations.scan, staged.plane.rows)
    if paper is None:
        return None
    seen = state.plane.intersect(state.camera.rays(np.concatenate([view.stripe for view in joint.views])))
    middle = seen.mean(axis=0)
    cosine = abs(float(paper.plane.n @ state.plane.n))
    return {
        "views": paper.views,
        "features": paper.features,
        "rms_mm": 1e3 * paper.rms,
        "cross_ratio_check_mm": 1e3 * paper.cross_ratio_m,
        "measured_mm": 1e3 * paper.measured_m,
        "apart_mrad": 1e3 * float(np.arccos(min(1.0, cosine))),
        "apart_mm": 1e3 * abs(float(paper.plane.distances(middle[None])[0])),
    }

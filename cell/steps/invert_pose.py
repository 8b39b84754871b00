"""Invert the place pose: the nominal surface registered in the cloud, with the board's pose as anchored prior."""

from __future__ import annotations

import numpy as np

from cell.geometry.poses import compose_covariance
from cell.inversion import NominalSurface, PlacePose, Prior, Tolerance
from cell.inversion import invert_pose as register
from cell.job import Job
from cell.steps.photograph import BoardFix
from cell.steps.reconstruct import Reconstruction
from cell.steps.step import JobStep
from cell.steps.workplace import Workplace
from drivers.interfaces import Vector
from statemachine.policy import Step
from statemachine.runner import StepContext


def invert_pose(scan: Reconstruction, fix: BoardFix, job: Job, nominal: NominalSurface, kinematic: Vector) -> PlacePose:
    """Where the surface is, in the arm base, with the covariance that stripe, rail, calibration and arm leave it with.

    The base is the arm's own, as it realises it where it places; `kinematic` (6, 6) is the covariance of the surface's
    place from what the arm's geometry leaves between calibration, sweep and placing. The prior is the board's pose
    carried on to the surface. Raises `RefusedError` when scan, surface and board do not fit together and
    `NotObservable` when a direction is not known to the job's tolerance.
    """
    board_from_surface = job.place_from_board.inverse() * job.surface.place_from_surface.se3()
    expected = fix.base_from_board * board_from_surface
    surface = job.surface
    mounting = np.diag([surface.prior_sigma**2] * 3 + [surface.prior_sigma_angle**2] * 3)
    spread = compose_covariance(fix.base_from_board, fix.covariance, board_from_surface, mounting)
    return register(
        scan.cloud,
        nominal,
        Prior(expected, spread),
        Tolerance(job.place.tolerance, job.place.tolerance_angle),
        systematic=kinematic,
        calibration=scan.by_calibration,
        sweeps=scan.by_poses,
    )


def _at(here: Workplace, context: StepContext) -> PlacePose:
    return invert_pose(context.made(Reconstruction), context.made(BoardFix), here.job, here.nominal, here.kinematic)


STEP = JobStep(Step("invert_pose", 60.0, on_wall=True), _at, PlacePose, needs=(BoardFix, Reconstruction))

"""Reconstruct: from the sweeps' profiles to the organised cloud in the arm base, written as PLY."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.measure.calibration import ScanCalibration
from cell.measure.reconstruction import (
    Cloud,
    Seam,
    calibration_motions,
    fill_holes,
    find_seams,
    flange_motions,
    lean_motions,
    merge,
    write_cloud,
)
from cell.measure.reconstruction.cloud import Array, Indices
from cell.measure.reconstruction.seams import Motions
from cell.procedures.observed import TimedCloud
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.errors import RefusedError
from statemachine.runner import StepContext
from statemachine.step import Step


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The cloud, how its sweeps agree where they overlap, and how its points move by one standard deviation of each
    independent parameter of the calibration, and by what each sweep's flange pose and the vehicle's lean are off."""

    cloud: Cloud
    seams: tuple[Seam, ...]
    by_calibration: Motions
    by_poses: Motions

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {**self.cloud.summary(), "seams": [seam.as_dict() for seam in self.seams]}


def build_cloud(sweep: SweepRecord) -> Cloud:
    """The sweeps' points in the arm base, outliers removed: all that lies between the last frame and the cloud."""
    return merge([s.builder.place(s.lines, s.flanges, s.rail, s.line_spread) for s in sweep.swaths])


def reconstruct(
    sweep: SweepRecord,
    calibration: ScanCalibration,
    largest_hole: float,
    path: Path,
    base_from_vehicle: pin.SE3,
    lean_sigma: float,
    simulated: Sequence[str] = (),
) -> Reconstruction:
    """Place every profile, remove outliers, interpolate holes up to `largest_hole` m and write the cloud to `path`.

    The vehicle, which carries the arm at `base_from_vehicle`, leans by `lean_sigma` rad, one standard deviation, per
    metre that the arm reaches out: an arm that moves during the sweeps moves its base, too. The file says which devices
    were `simulated`. Raises `RefusedError` when
    too few points are left; what there is of a cloud is written all the same.
    """
    built = build_cloud(sweep)
    try:
        cloud = fill_holes(built.require(), largest_hole)
    except RefusedError as refused:
        write_cloud(path, built, simulated)
        refused.showing(seen={"cloud": built})
        raise
    # The same for all sweeps: what the calibration found, with the laser where it pointed before them.
    geometry, variants = sweep.swaths[0].builder.geometry, calibration.variants()
    covariances = [swath.covariance for swath in sweep.swaths]

    def by_calibration(lines: Indices, rows: Indices) -> Array:
        return calibration_motions(cloud, lines, rows, base_from_flange=None, geometry=geometry, variants=variants)

    def by_poses(lines: Indices, rows: Indices) -> Array:
        leaning = lean_motions(cloud, lines, rows, base_from_vehicle, lean_sigma)
        return np.concatenate([flange_motions(cloud, lines, rows, covariances), leaning], axis=2)

    def by_both(lines: Indices, rows: Indices) -> Array:
        return np.concatenate([by_calibration(lines, rows), by_poses(lines, rows)], axis=2)

    seams = tuple(find_seams(cloud, by_both))
    write_cloud(path, cloud, simulated)
    return Reconstruction(cloud, seams, by_calibration, by_poses)


def reconstructed(here: Workplace, sweep: SweepRecord) -> Reconstruction:
    """`reconstruct` where a job is done; the cloud is `cloud.ply` in its folder."""
    path = here.folder / "cloud.ply"
    # The cloud of an earlier sweep must not be taken for this one's.
    path.unlink(missing_ok=True)
    head = here.calibration.scan
    return reconstruct(
        sweep,
        head if sweep.pointing is None else head.pointed(sweep.pointing, here.config.laser.exit_point),
        here.job.scan.largest_hole,
        path=path,
        base_from_vehicle=here.config.arm.vehicle_from_base.se3().inverse(),
        lean_sigma=here.config.vehicle.lean_sigma,
        simulated=here.config.cell.sim,
    )


def _at(here: Workplace, context: StepContext) -> Reconstruction:
    sweep = context.made(SweepRecord)
    made = reconstructed(here, sweep)
    here.devices.gate.seen("scan_camera", TimedCloud(made.cloud, sweep.times))
    return made


STEP = JobStep(Step("reconstruct", 60.0, on_wall=True), _at, Reconstruction, needs=(SweepRecord,))

"""Reconstruct: from the sweeps' profiles to the organised cloud in the arm base, written as PLY."""

from dataclasses import dataclass

import numpy as np

from cell.measure.reconstruction.build import calibration_motions, flange_motions, lean_motions
from cell.measure.reconstruction.cloud import Array, Cloud, Indices, Motions, Seam, find_seams, merge
from cell.measure.reconstruction.holes import fill_holes
from cell.measure.reconstruction.ply import write_cloud
from cell.procedures.steps.laser_sweep import head_at
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.errors import RefusedError
from drivers.interfaces import Vector
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


@dataclass(frozen=True, eq=False)
class TimedCloud:
    """A cloud, and the host `times` (lines,) in s at which its lines were taken."""

    cloud: Cloud
    times: Vector


def build_cloud(sweep: SweepRecord) -> Cloud:
    """The sweeps' points in the arm base, outliers removed: all that lies between the last frame and the cloud."""
    return merge([s.builder.place(s.lines, s.flanges, s.rail, s.line_spread) for s in sweep.swaths])


def reconstructed(workplace: Workplace, sweep: SweepRecord) -> Reconstruction:
    """Place every profile, remove outliers, interpolate the job's largest holes; the cloud is `cloud.ply` of the run.

    The file says which devices were simulated. Raises `RefusedError` when too few points are left; what there is of a
    cloud is written all the same.
    """
    path, simulated = workplace.folder / "cloud.ply", workplace.config.cell.sim
    # The cloud of an earlier sweep must not be taken for this one's.
    path.unlink(missing_ok=True)
    built = build_cloud(sweep)
    try:
        cloud = fill_holes(built.require(), workplace.job.scan.largest_hole)
    except RefusedError as refused:
        write_cloud(path, built, simulated)
        refused.showing(seen={"cloud": built})
        raise
    by_calibration, by_poses = displacements(workplace, sweep, cloud)
    seams = tuple(find_seams(cloud, together(by_calibration, by_poses)))
    write_cloud(path, cloud, simulated)
    return Reconstruction(cloud, seams, by_calibration, by_poses)


def together(*motions: Motions) -> Motions:
    """How points move by the parameters of all these motions."""
    return lambda lines, rows: np.concatenate([each(lines, rows) for each in motions], axis=2)


def displacements(workplace: Workplace, sweep: SweepRecord, cloud: Cloud) -> tuple[Motions, Motions]:
    """How the points of a sweep's cloud move by what is not known of the calibration, and of the arm's poses."""
    # The same for all sweeps: what the calibration found, with the laser where it pointed before them.
    geometry, variants = sweep.swaths[0].builder.geometry, head_at(workplace, sweep).variants()
    covariances = [swath.covariance for swath in sweep.swaths]
    # An arm that moves during the sweeps moves its base, too: the vehicle leans as the arm reaches out.
    vehicle, lean = workplace.config.arm.vehicle_from_base.se3().inverse(), workplace.config.vehicle.lean_sigma

    def by_calibration(lines: Indices, rows: Indices) -> Array:
        return calibration_motions(cloud, lines, rows, base_from_flange=None, geometry=geometry, variants=variants)

    def by_poses(lines: Indices, rows: Indices) -> Array:
        leaning = lean_motions(cloud, lines, rows, vehicle, lean)
        return np.concatenate([flange_motions(cloud, lines, rows, covariances), leaning], axis=2)

    return by_calibration, by_poses


def _run_step(workplace: Workplace, context: StepContext) -> Reconstruction:
    sweep = context.made(SweepRecord)
    made = reconstructed(workplace, sweep)
    workplace.devices.gate.seen("scan_camera", TimedCloud(made.cloud, sweep.times))
    return made


STEP = JobStep(Step("reconstruct", 60.0, on_wall=True), _run_step, Reconstruction, needs=(SweepRecord,))

"""How far the points of simulated sweeps lie from their true places, frame by frame.

The true place of a point is where the light plane really met the true surface in that image row, so that the noise of
the stripe is part of the point's error. The camera's own frame is partly a convention: a shift of the principal point
looks like a turn of the camera and is undone by the hand-eye. The scan frame
is the camera's at rail zero: what is told there holds camera, light plane, rail and stripe and nothing of the arm, of
which the hand-eye has part. Beside it, the error after the best rigid motion, which is free of that convention.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import chi2

from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import from_matrix, mean, transform
from cell.measure.inversion import NominalSurface
from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.part_error import part_points
from cell.procedures.steps.reconstruct import Reconstruction
from cell.run.report.report import SENSOR_POINTS, pose_of
from drivers.interfaces import Vector
from lab.bench.job.whole_job import JobRecord
from lab.paper.rig import aligned
from sim_backends.models.arm import ArmParams
from sim_backends.models.arm_kinematics import UR10E_DH, JointErrors, Kinematics
from sim_backends.world.drawing import inverse
from sim_backends.world.scene import draw

Indices = NDArray[np.intp]

NEAR_M = 0.001
"""A scanned point at most this far from one of the part's 45 points stands for it."""
COVERED = 0.95
_SAME_PLACE_M = 1e-3
_SLIDES, _PROBE_PX, _ON_SURFACE_M = 4, 0.2, 2e-6


@dataclass(frozen=True, eq=False)
class ScanErrors:
    """Distances in m of about 1000 scanned points, evenly spread over the surface, from their true places.

    `scan` (n,): in the camera's frame at rail zero; `aligned` (n,): there after the best rigid motion. `own` and
    `absolute` (at most 45,): of the points next to the part's, in the arm's own base and in the true one. `inside`
    (n,): within the stated 95 % ellipsoid, in the arm's own base.
    """

    scan: Vector
    aligned: Vector
    own: Vector
    absolute: Vector
    inside: Vector


@dataclass(frozen=True, eq=False)
class _Compared:
    """Points (n, 3) in the flange's frame as reconstructed and as true, and their places in the cloud."""

    found: Vector
    true: Vector
    lines: Indices
    rows: Indices


def scan_errors(record: JobRecord, nominal: NominalSurface, kinematic: Vector) -> ScanErrors | None:
    """The errors of a record's cloud, None when it has none. `kinematic` (6, 6), m² and rad²: the covariance that is
    stated of a place in the base that the arm realises."""
    made = record.results.get("reconstruct")
    if not isinstance(made, Reconstruction):
        return None
    cloud = made.cloud
    assert record.calibration is not None and record.at_sweep is not None
    lines, rows = cloud.valid.nonzero()
    on_surface, _ = _true_points(record, nominal, cloud, lines, rows)
    chosen = on_surface[np.linspace(0, len(on_surface) - 1, SENSOR_POINTS).astype(int)]
    some = _compare(record, nominal, cloud, lines[chosen], rows[chosen])
    truth = record.at_sweep
    reported, flanges = cloud.flanges, np.array([shot.base_from_flange for shot in record.shots])
    own_from_base = own_base(record)
    by_camera = record.calibration.scan.flange_from_camera.inverse()
    true_by_camera = pose_of(truth, "flange_from_scan_camera").inverse()
    in_camera, true_in_camera = transform(by_camera, some.found), transform(true_by_camera, some.true)
    off = _moved(reported[some.lines], some.found) - transform(own_from_base, _moved(flanges[some.lines], some.true))
    arms = by_pose(cloud.points[some.lines, some.rows] - pose_of(truth, "base_from_surface").translation)
    stated = _stated(made, some) + arms @ kinematic @ arms.transpose(0, 2, 1)
    near = _near_part(record, nominal, cloud, lines, rows)
    part = _compare(record, nominal, cloud, lines[near], rows[near])
    found, true = _moved(reported[part.lines], part.found), _moved(flanges[part.lines], part.true)
    return ScanErrors(
        scan=_length(in_camera - true_in_camera), aligned=_length(aligned(in_camera, true_in_camera)),
        own=_length(found - transform(own_from_base, true)), absolute=_length(found - true),
        inside=np.einsum("ni,nij,nj->n", off, np.linalg.inv(stated), off) <= chi2.ppf(COVERED, 3),
    )  # fmt: skip


def own_base(record: JobRecord) -> pin.SE3:
    """own_from_base: the base as the arm realises it in the posture in which it places, against the true base. From the
    true lengths and zeros of the world's arm and what its joints are off; repeatability is not part of it."""
    assert record.rests is not None
    pose = record.results.get("place")
    scene = draw(record.seed, record.level)
    told = UR10E_DH + scene.dh_factory
    flanges = np.array([Kinematics(told).forward(q) for q in record.rests])
    wanted = (pose if pose is not None else record.results["laser_sweep"]).base_from_flange.homogeneous
    away = np.abs(flanges - wanted).reshape(len(flanges), -1).max(axis=1)
    nearest = int(np.argmin(away))
    kinematics = Kinematics(told + scene.dh_error)
    bent = JointErrors(kinematics, scene.workshop.harmonics, scene.effects.sag, ArmParams.carried)
    true = kinematics.forward(bent.true(record.rests[nearest]))
    return from_matrix(flanges[nearest]) * from_matrix(true).inverse()


def surface_at_middle(record: JobRecord) -> pin.SE3:
    """base_from_surface when the arm was in the middle of all lines: a vehicle leans otherwise wherever it reaches. Its
    rocking is averaged out, over all lines that were taken with the arm there."""
    flanges = np.array([shot.base_from_flange[:3, 3] for shot in record.shots])
    away = np.linalg.norm(flanges - flanges.mean(axis=0), axis=1)
    there = np.flatnonzero(away < away.min() + _SAME_PLACE_M)
    return mean([from_matrix(record.shots[k].base_from_surface) for k in there])


def true_geometry(record: JobRecord) -> ScanGeometry:
    """The scan head as it is; what the rail reads is then the carriage's true displacement."""
    assert record.at_sweep is not None and record.calibration is not None
    truth, made = record.at_sweep, record.calibration.scan.camera
    lens, plane = truth["scan_lens"], truth["light_plane"]
    camera = CameraModel(made.width, made.height, lens["fx"], lens["fy"], lens["cx"], lens["cy"], tuple(lens["dist"]))
    return ScanGeometry(
        camera,
        # The world tells the bow by the distance from the laser, the plane by that along the optical axis.
        LightPlane.of(np.array(plane["normal"]), plane["distance"]).bowed(
            plane["bow"] * float(np.sqrt(1.0 - plane["normal"][2] ** 2))
        ),
        np.array(truth["rail"]["direction"]),
        pose_of(truth, "flange_from_scan_camera"),
    )


def _true_points(
    record: JobRecord, nominal: NominalSurface, cloud: Cloud, lines: Indices, rows: Indices
) -> tuple[Indices, Vector]:
    """Which of the points have a true place on the surface (indices), and that place (m, 3) in the true flange."""
    shots = record.shots
    carriage = np.array([shot.carriage for shot in shots])[lines]
    surface_from_flange = np.array([inverse(s.base_from_surface) @ s.base_from_flange for s in shots])[lines]
    geometry = true_geometry(record)
    pixels = np.column_stack([cloud.centres[lines, rows], rows.astype(np.float64)])

    def height(at: Vector) -> Vector:
        return nominal.deviations(_moved(surface_from_flange, geometry.solve(at, carriage)[0]))

    for _ in range(_SLIDES):
        above = height(pixels)
        slope = (height(pixels + np.array([_PROBE_PX, 0.0])) - above) / _PROBE_PX
        pixels[:, 0] -= np.clip(np.nan_to_num(above / slope), -2.0, 2.0)
    good = np.flatnonzero(np.abs(np.nan_to_num(height(pixels), nan=1.0)) < _ON_SURFACE_M)
    return good, geometry.solve(pixels, carriage)[0][good]


def _compare(record: JobRecord, nominal: NominalSurface, cloud: Cloud, lines: Indices, rows: Indices) -> _Compared:
    assert record.calibration is not None
    good, true = _true_points(record, nominal, cloud, lines, rows)
    lines, rows = lines[good], rows[good]
    pixels = np.column_stack([cloud.centres[lines, rows], rows.astype(np.float64)])
    # As it was measured, with the laser where its witness showed it before the sweep.
    geometry = record.results["laser_sweep"].swaths[0].builder.geometry
    found, _ = geometry.solve(pixels, cloud.rail[lines])
    return _Compared(found, true, lines, rows)


def _stated(made: Reconstruction, some: _Compared) -> Vector:
    """Covariances (n, 3, 3) in m², base axes: stripe, rail, calibration and the sweeps' poses."""
    stated = made.cloud.covariances(some.lines, some.rows)
    for motions in (made.by_calibration, made.by_poses):
        moved = motions(some.lines, some.rows)
        stated = stated + moved @ moved.transpose(0, 2, 1)
    return stated


def _moved(poses: Vector, points: Vector) -> Vector:
    """Points (n, 3), each moved by the pose (n, 4, 4) of its own."""
    return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3])


def by_pose(arms: Vector) -> Vector:
    """∂point/∂(δt, δφ) (n, 3, 6) of points at `arms` (n, 3) from the pose's origin."""
    return np.stack([np.hstack([np.eye(3), -pin.skew(arm)]) for arm in arms])


def _near_part(record: JobRecord, nominal: NominalSurface, cloud: Cloud, lines: Indices, rows: Indices) -> Indices:
    """Indices of the points next to the part's 45 points, where there are any."""
    assert record.at_sweep is not None
    local = transform(pose_of(record.at_sweep, "base_from_surface").inverse(), cloud.points[lines, rows])
    away, nearest = cKDTree(local).query(part_points(nominal), distance_upper_bound=NEAR_M)
    return np.asarray(nearest)[np.isfinite(away)]


def _length(vectors: Vector) -> Vector:
    return np.asarray(np.linalg.norm(vectors, axis=1))

"""What the world's declared noise leaves the whole job with at best: covariances, and the mean distances to expect.

Propagated to first order through the product's own chain: dots and stripe as their residuals show them; the arm's
repeatability at every calibration view, for the sweep and for placing; its kinematic error, one draw of link lengths
and joint zeros that shifts all postures together and is partly taken up by the hand-eye; the grasp and the vehicle's
lean. Least squares with these covariances attains the Cramér–Rao bound, save for the kinematic error, which the
adjustment does not know of: for that part the figure is what this estimator is expected to make of it.
"""

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.measure.calibration.solve.adjustment import Adjustment, Priors, shared_mask
from cell.measure.calibration.solve.joint import solve_joint, solve_staged
from cell.measure.calibration.solve.normal import SHARED, AdjustmentState
from cell.measure.geometry.poses import composition_jacobians, covariance_root, transform
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.reconstruction.build import ScanGeometry, calibration_motions, flange_motions
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.part_error import part_points
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.interfaces import Vector
from lab.bench.job.scan_errors import by_pose
from lab.bench.job.whole_job import JobRecord
from sim_backends.models.arm_kinematics import UR10E_DH, Kinematics
from sim_backends.world.scene import draw

POINTS = 1500
_STEP = 1e-6
_DRAWS = 1000
UNDERSIDE = 400
"""So many points of the underside are looked at for the first contact."""


def expect(record: JobRecord, config: CellConfig, job: Job, nominal: NominalSurface) -> dict[str, float]:
    """Mean distances in m to expect, of a record that got as far as the place pose.

    Over the part's 45 points: `absolute` in the arm's true base, `own` in the base as the arm itself realises it where
    it places, `placing` once contact has let the part rest. `sensor`: single points in the camera's frame at rail zero.
    """
    assert record.calibration is not None and record.at_sweep is not None and record.rests is not None
    noise = {name: entry["sigma"] for name, entry in record.at_sweep["assumed_noise"].items()}
    cloud: Cloud = record.results["reconstruct"].cloud
    sweep: SweepRecord = record.results["laser_sweep"]
    pose = record.results["invert_pose"]
    kinematics = _Kinematics(record.rests, UR10E_DH + draw(record.seed, record.level).dh_factory)
    shared, by_kinematics = _calibration(record, config, noise, kinematics)
    rest = np.diag([noise["arm_repeatability"] ** 2 / 3] * 3 + [noise["arm_repeatability_rotation"] ** 2] * 3)
    head = _Head(record, cloud, [rest] * len(sweep.swaths), nominal, pose.base_from_surface)

    at_surface = _carried(sweep.base_from_flange, pose.base_from_surface)
    place_flange = (
        pose.base_from_surface * job.place.surface_from_part.se3() * job.grasp.flange_from_part.se3().inverse()
    )
    at_part = _carried(place_flange, pose.base_from_surface)
    lengths, zeros = noise["arm_dh_length"], noise["arm_dh_angle"]
    sigma = np.concatenate([np.full(12, lengths), np.full(6, zeros)])
    scan = -at_surface @ kinematics.shifts(sweep.base_from_flange) * sigma - head.poses(by_kinematics * sigma)
    own = scan + at_part @ kinematics.shifts(place_flange) * sigma
    common = pose.random + _square(head.by_rests) + _square(head.poses(covariance_root(shared)))
    placing = common + _square(own) + at_part @ rest @ at_part.T + _grasp(noise, pose.base_from_surface)
    placing = placing + _square(_lean(noise, config, sweep.base_from_flange, place_flange, pose.base_from_surface))
    points = transform(pose.base_from_surface, part_points(nominal)) - pose.base_from_surface.translation

    def mean(covariance: Vector) -> float:
        arms = by_pose(points)
        return mean_distance(arms @ covariance @ arms.transpose(0, 2, 1))

    in_camera = head.in_camera(np.concatenate([covariance_root(shared), by_kinematics * sigma], axis=1))
    return {
        "absolute": mean(common + _square(scan)), "own": mean(common + _square(own)),
        "placing": mean_after_contact(placing, nominal, pose), "sensor": mean_distance(in_camera),
    }  # fmt: skip


def mean_distance(covariances: Vector) -> float:
    """Mean length in m of Gaussian errors with covariances (n, 3, 3), over all of them."""
    values, vectors = np.linalg.eigh(covariances)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    draws = np.random.default_rng(0).standard_normal((_DRAWS, 1, 3, 1))
    return float(np.linalg.norm((roots @ draws)[..., 0], axis=-1).mean())


def mean_after_contact(placing: Vector, nominal: NominalSurface, pose: PlacePose) -> float:
    """Mean distance in m of the part's 45 points from where they belong, once it rests.

    The part comes down until it touches the highest point of the ground under it. So its height error is not the
    cell's, but what tilt and slope leave of the other five errors.

    `placing` (6, 6) is the covariance of the part's place in the air, base axes, about the surface's origin; down is
    the base's -z.
    """
    values, vectors = np.linalg.eigh(placing)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    steps = np.random.default_rng(0).standard_normal((_DRAWS, 6)) @ root.T
    every = max(1, len(nominal.samples) // UNDERSIDE)
    surface = pose.base_from_surface
    under = transform(surface, nominal.samples[::every]) - surface.translation
    normals = nominal.normals[nominal.sample_triangles[::every]] @ surface.rotation.T
    # How far the underside lies over the ground, straight down, where it is displaced by d: n·d / n_z.
    above = (steps @ by_pose(under).transpose(0, 2, 1)).transpose(1, 0, 2)
    drop = np.einsum("kni,ni->kn", above, normals / normals[:, 2:]).min(axis=1)
    points = transform(surface, part_points(nominal)) - surface.translation
    ended = (steps @ by_pose(points).transpose(0, 2, 1)).transpose(1, 0, 2)
    ended[:, :, 2] -= drop[:, None]
    return float(np.linalg.norm(ended, axis=2).mean())


class _Kinematics:
    """How the flange moves with the 18 lengths and zeros of the arm's table, at the postures that it rested in."""

    def __init__(self, rests: Vector, told: Vector) -> None:
        self._rests = rests
        self._table = told
        self._nominal = Kinematics(told)
        self._flanges = np.array([self._nominal.forward(q) for q in rests])

    def shifts(self, base_from_flange: pin.SE3) -> Vector:
        """(6, 18): translation and rotation in base axes per m of a and d and per rad of the joints' zeros."""
        wanted = base_from_flange.homogeneous
        away = np.abs(self._flanges - wanted).reshape(len(self._flanges), -1).max(axis=1)
        return self._by_table(self._rests[int(np.argmin(away))])

    def _by_table(self, joints: Vector) -> Vector:
        at = self._nominal.forward(joints)
        columns = []
        for column, row in [(c, r) for c in (0, 1, 3) for r in range(6)]:
            table = self._table.copy()
            table[row, column] += _STEP
            moved = Kinematics(table).forward(joints)
            turn = pin.log3(moved[:3, :3] @ at[:3, :3].T)
            columns.append(np.concatenate([moved[:3, 3] - at[:3, 3], turn]) / _STEP)
        return np.column_stack(columns)


class _Head:
    """How the cloud, and the pose found in it, move with the scan head's parameters and with the sweeps' poses.

    `rests`: the covariance (6, 6) of base_from_flange of each sweep. `by_rests` (6, m): motions of the surface's pose
    by one standard deviation of each of their parts.
    """

    def __init__(
        self, record: JobRecord, cloud: Cloud, rests: list[Vector], nominal: NominalSurface, surface: pin.SE3
    ) -> None:
        assert record.calibration is not None
        self._calibration = record.calibration.scan
        self._cloud = cloud
        self._lines, self._rows = cloud.subsample(POINTS)
        points = cloud.points[self._lines, self._rows]
        chosen, feet = nominal.feet(transform(surface.inverse(), points), 0.0005)
        keep = chosen[feet.inner]
        self._lines, self._rows = self._lines[keep], self._rows[keep]
        normals = feet.normals[feet.inner] @ surface.rotation.T
        arms = points[keep] - surface.translation
        self._normals = normals
        by_pose = np.concatenate([normals, np.cross(arms, normals)], axis=1)
        by_sweeps = np.einsum("ni,nim->nm", normals, flange_motions(cloud, self._lines, self._rows, rests))
        columns = np.concatenate([by_pose, by_sweeps], axis=1)
        weighted = columns / cloud.sigma_along(self._lines, self._rows, normals)[:, None] ** 2
        # What the sweeps' poses are off is found with the pose, and known beforehand to its standard deviation.
        known = np.diag([0.0] * 6 + [1.0] * by_sweeps.shape[1])
        self._rigid = np.linalg.solve(weighted.T @ columns + known, weighted.T)[:6]
        self.by_rests: Vector = self._rigid @ by_sweeps

    def poses(self, steps: Vector) -> Vector:
        """Motion (6, m) of the surface's pose for steps (21, m) of the parameters, by points along the normals."""
        moved = self._moved(steps, None, self._calibration.flange_from_camera)
        return np.asarray(self._rigid @ np.einsum("ni,nim->nm", self._normals, moved))

    def in_camera(self, steps: Vector) -> Vector:
        """Covariances (n, 3, 3) of single points in the camera's frame at rail zero: parameters, stripe and rail."""
        moved = self._moved(steps, pin.SE3.Identity(), pin.SE3.Identity())
        turns = self._cloud.flanges[self._lines, :3, :3] @ self._calibration.flange_from_camera.rotation
        random = turns.transpose(0, 2, 1) @ self._cloud.covariances(self._lines, self._rows) @ turns
        return np.asarray(random + moved @ moved.transpose(0, 2, 1))

    def _moved(self, steps: Vector, base_from_flange: pin.SE3 | None, hand: pin.SE3) -> Vector:
        c = self._calibration
        state = AdjustmentState(c.camera, c.light_plane, c.rail_direction, hand, pin.SE3.Identity())
        variants = []
        for step in steps.T:
            full = np.zeros(SHARED)
            full[: len(step)] = step
            if hand == pin.SE3.Identity():
                full[15:21] = 0.0
            moved = state.moved(full)
            assert moved.plane is not None
            variants.append(ScanGeometry(moved.camera, moved.plane, moved.rail_direction, moved.flange_from_camera))
        geometry = ScanGeometry(c.camera, c.light_plane, c.rail_direction, hand)
        return calibration_motions(self._cloud, self._lines, self._rows, base_from_flange, geometry, variants)


def _calibration(
    record: JobRecord, config: CellConfig, noise: dict[str, float], kinematics: _Kinematics
) -> tuple[Vector, Vector]:
    """Covariance (21, 21) of the scan head's parameters under the declared noise, and their shift (21, 18) by the
    arm's kinematic error: the flange is not where it is reported, view by view, and the adjustment follows."""
    observations = record.observations[0]
    staged = solve_staged(observations, nominal_camera(config.scan_camera), np.array([1.0, 0.0, 0.0]))
    priors = Priors(
        arm_translation=max(noise["arm_repeatability"] / np.sqrt(3.0), 1e-6),
        arm_rotation=max(noise["arm_repeatability_rotation"], 1e-6),
        rail=config.calibration.rail_sigma,
    )
    joint = solve_joint(observations, staged, priors, held_out=False)
    problem = Adjustment(joint.views, shared_mask(plane=True, rail=True), joint.adjusted.priors)
    inverse = problem.normal_at(joint.adjusted.state).inverse()
    weight = 1.0 / np.array([priors.arm_translation**2] * 3 + [priors.arm_rotation**2] * 3)
    shift = np.zeros((SHARED, 18))
    for k, view in enumerate(joint.views):
        if view.same_rest:
            continue
        # The arm stands where the table's error puts it; what is reported lies the opposite way from it.
        shift -= inverse.cross[k][:, :6] * weight @ kinematics.shifts(view.base_from_flange)
    return inverse.shared[:21, :21], shift[:21]


def _carried(base_from_flange: pin.SE3, base_from_surface: pin.SE3) -> Vector:
    """(6, 6): motion of what the flange carries, about the surface's origin, for a motion of the flange."""
    return composition_jacobians(base_from_flange, base_from_flange.inverse() * base_from_surface)[0]


def _grasp(noise: dict[str, float], base_from_surface: pin.SE3) -> Vector:
    turn = np.kron(np.eye(2), base_from_surface.rotation)
    return np.asarray(
        turn @ np.diag([noise["grasp_translation"] ** 2] * 3 + [noise["grasp_rotation"] ** 2] * 3) @ turn.T
    )


def _lean(
    noise: dict[str, float], config: CellConfig, scan: pin.SE3, place: pin.SE3, base_from_surface: pin.SE3
) -> Vector:
    """(6, 2): the body leans otherwise when the arm has moved on from the sweep; one σ of each of its two springs."""
    vehicle_from_base = config.arm.vehicle_from_base.se3()
    reach = place.translation - scan.translation
    turns = (
        vehicle_from_base.rotation.T @ np.array([[0.0, -reach[1]], [reach[0], 0.0], [0.0, 0.0]]) * noise["suspension"]
    )
    arm = base_from_surface.translation - vehicle_from_base.inverse().translation
    return np.concatenate([np.cross(turns.T, arm).T, turns])


def _square(columns: Vector) -> Vector:
    return np.asarray(columns @ columns.T)

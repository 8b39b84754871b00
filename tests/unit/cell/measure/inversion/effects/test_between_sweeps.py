"""A surface that creeps between two sweeps: its cloud is put back, its place carried on with what is not known."""

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.geometry.poses import difference
from cell.measure.inversion.effects import between_sweeps
from cell.measure.inversion.effects.between_sweeps import GATE_M, LEAST_MOTION_M, Creep, PartOnGround
from cell.measure.reconstruction.cloud import Cloud
from lab.bench.job.whole_job import JobRecord
from tests.support.report_runs import pot


def test_what_is_not_known_of_a_rate_grows_with_the_time(placed_pot: JobRecord):
    made = placed_pot.results
    pose, cloud, times = made["invert_pose"], made["reconstruct"].cloud, made["laser_sweep"].times
    unsure = np.diag([1e-6**2, 0.0, 0.0, 0.0, 0.0, 2e-6**2])
    creep = Creep(np.array([3e-6, 0, 0, 0, 0, 0]), unsure, pose.base_from_surface.translation, times[0] + 1.0)
    later = creep.carried(pose, times[0] + 4.0)
    np.testing.assert_allclose(later.covariance - pose.covariance, 9.0 * unsure, atol=1e-16)
    np.testing.assert_allclose(later.systematic - pose.systematic, 9.0 * unsure, atol=1e-16)
    crept = difference(later.base_from_surface, pose.base_from_surface)
    np.testing.assert_allclose(crept, 3.0 * creep.rate, atol=1e-12)
    lines, rows = (each[::997] for each in np.nonzero(cloud.valid))
    moved = creep.motions(cloud, lines, rows, times)
    arms, seconds = cloud.points[lines, rows] - creep.origin, (times[lines] - creep.since)[:, None]
    turned = np.cross([0.0, 0.0, 2e-6], arms)
    expected = np.einsum("ni,nj->nij", seconds * [1e-6, 0, 0], seconds * [1e-6, 0, 0])
    expected += np.einsum("ni,nj->nij", seconds * turned, seconds * turned)
    np.testing.assert_allclose(np.einsum("nim,njm->nij", moved, moved), expected, atol=1e-18)


def test_a_cloud_that_crept_is_put_back_to_where_it_was_in_the_middle_of_the_sweep(placed_pot: JobRecord):
    cloud, times = placed_pot.results["reconstruct"].cloud, placed_pot.results["laser_sweep"].times
    origin, since = cloud.points[cloud.valid].mean(axis=0), float(times.mean())
    creep = Creep(np.array([3e-4, -2e-4, 1e-4, 0.0, 0.0, 2e-3]), np.zeros((6, 6)), origin, since)
    seconds = (times - since)[:, None, None]
    arms = cloud.points - origin
    turned = 2e-3 * np.stack([-arms[..., 1], arms[..., 0], np.zeros(arms.shape[:2])], axis=-1)
    crept = replace(cloud, points=cloud.points + seconds * (np.array([3e-4, -2e-4, 1e-4]) + turned))
    # What is left is of second order: the arms are those of points that crept.
    left = (creep.undone(crept, times).points - cloud.points)[cloud.valid]
    assert np.abs(left).max() < 1e-6 < np.abs((crept.points - cloud.points)[cloud.valid]).max()


KNOWN = np.diag([1e-6**2] * 6)


def lying(record: JobRecord) -> tuple[PartOnGround, Cloud]:
    """The surface of a job in the place of a part, and its cloud."""
    return PartOnGround(pot()[1], record.results["invert_pose"].base_from_surface), record.results["reconstruct"].cloud


def every_fourth(cloud: Cloud, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), turn: float = 0.0) -> Cloud:
    """A cloud of the other lines, moved, and turned about z and its middle."""
    points, moved = np.full_like(cloud.points, np.nan), cloud.points + np.array(shift)
    arms = cloud.points - (cloud.points[cloud.valid].mean(axis=0) if cloud.size else 0.0)
    moved += turn * np.stack([-arms[..., 1], arms[..., 0], np.zeros(arms.shape[:2])], axis=-1)
    points[2::4] = moved[2::4]
    return replace(cloud, points=points)


@pytest.mark.parametrize("shift", [(0.0, 0.06e-3, 0.0), (0.05e-3, -0.05e-3, 0.02e-3), (0.0, 0.0, -0.06e-3)])
def test_a_motion_comes_out_as_it_was_put_in(placed_pot: JobRecord, shift: tuple[float, float, float]):
    part, cloud = lying(placed_pot)
    found = part.moved(cloud, every_fourth(cloud, shift), KNOWN)
    assert found == pytest.approx(np.linalg.norm(shift), abs=0.01e-3)
    assert part.moved(cloud, every_fourth(cloud), KNOWN) == 0.0
    # What the sweeps may lie apart for another reason is no motion of the part.
    assert part.moved(cloud, every_fourth(cloud, shift), np.diag([0.1e-3**2] * 6)) == 0.0


def test_less_than_matters_is_none_and_what_does_not_show_is_not_known(placed_pot: JobRecord, monkeypatch):
    part, cloud = lying(placed_pot)
    nothing, little = every_fourth(replace(cloud, points=np.full_like(cloud.points, np.nan))), 1e-3
    assert part.moved(cloud, every_fourth(cloud, turn=little), KNOWN) == 0.0
    monkeypatch.setattr(between_sweeps, "LEAST_MOTION_M", 0.0)
    assert 0.0 < part.moved(cloud, every_fourth(cloud, turn=little), KNOWN) < LEAST_MOTION_M
    assert part.moved(nothing, every_fourth(cloud), KNOWN) is None
    assert part.moved(cloud, nothing, KNOWN) == part.moved(cloud, every_fourth(cloud, (0, 0, 9e-3)), KNOWN) == GATE_M

"""A carriage that sinks along its travel, planted into the cloud of a good sweep, is in the stated covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.geometry.poses import difference
from cell.measure.inversion import PlacePose
from cell.measure.inversion.effects.droop import Droop, Head
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.steps.invert_pose import LineTimes
from cell.procedures.steps.invert_pose import invert_pose as step
from drivers.errors import NotObservable
from lab.bench.job.whole_job import JobRecord
from tests.support.report_runs import CONFIG, pot


def head_of(record: JobRecord, cloud: Cloud) -> Head:
    assert record.calibration is not None
    scan, sweep = record.calibration.scan, record.results["laser_sweep"]
    travel = CONFIG.rail.travel[1]
    return Head.of(cloud, sweep.base_from_flange, scan.flange_from_camera, scan.rail_direction, travel)


def inverted(record: JobRecord, sag: float) -> PlacePose:
    """By the job's step, with the carriage sunk by `sag` m at the end of its travel."""
    made, (job, nominal) = record.results, pot()
    cloud, sweep = made["reconstruct"].cloud, made["laser_sweep"]
    lines, rows = np.nonzero(cloud.valid)
    points = cloud.points.copy()
    points[lines, rows] -= Droop(sag, 0.0, head_of(record, cloud)).motions(cloud, lines, rows).sum(axis=2)
    bent = replace(cloud, points=points)
    vehicle = CONFIG.arm.vehicle_from_base.se3().inverse()
    taken = LineTimes(sweep.times, vehicle, head_of(record, bent))
    assert record.kinematic is not None
    return step(replace(made["reconstruct"], cloud=bent), made["board_photo"], job, nominal, record.kinematic, taken)


@pytest.mark.parametrize("sag", [0.1e-3, -0.1e-3, 0.15e-3])
def test_a_carriage_that_droops_is_told_and_in_the_stated_covariance(placed_pot: JobRecord, sag: float) -> None:
    good, found = placed_pot.results["invert_pose"], inverted(placed_pot, sag)
    (note,) = found.notes
    assert "bowed along the rail, as if its carriage had sunk by" in note and "cell calibrate" in note
    off = difference(good.base_from_surface, found.base_from_surface)
    assert np.linalg.norm(off[3:]) > 0.5e-3
    assert off @ np.linalg.solve(good.covariance, off) > 12.6
    assert off @ np.linalg.solve(found.covariance, off) < 12.6


def test_without_a_droop_nothing_is_added_and_too_large_a_one_is_refused(placed_pot: JobRecord) -> None:
    good, found = placed_pot.results["invert_pose"], inverted(placed_pot, 0.0)
    assert found.notes == good.notes == ()
    np.testing.assert_array_equal(found.covariance, good.covariance)
    with pytest.raises(NotObservable, match=r"not determined.*as if its carriage had sunk by 0\.[3-5]"):
        inverted(placed_pot, 0.4e-3)

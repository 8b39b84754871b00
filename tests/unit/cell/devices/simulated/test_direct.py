"""The whole job on the cell without wires is as good as its declared noise allows."""

from typing import Any

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.measure.inversion import NominalSurface
from lab.bench.job.accuracy import LIMITS, figures, summed_up
from lab.bench.job.expected import mean_distance
from lab.bench.job.whole_job import JobRecord, run_whole_job
from tests.support.report_runs import pot

CONFIG = load_config(None)
Run = dict[str, Any]


def test_the_mean_length_of_a_round_gaussian_error_is_the_closed_form():
    # Maxwell's distribution: 2 σ √(2/π).
    assert mean_distance(np.eye(3)[None] * 4e-10) == pytest.approx(2 * 2e-5 * np.sqrt(2 / np.pi), rel=0.03)


SWEEP_SPEED = 0.030
"""Twice as fast as shipped, m/s: half the lines are enough for a test."""


def whole_job(name: str, changes: dict[str, object], calibrated: JobRecord | None = None) -> tuple[JobRecord, Run]:
    job, mesh = load_job(name)
    job = job.model_copy(update={"scan": job.scan.model_copy(update={"speed": SWEEP_SPEED, **changes})})
    nominal = NominalSurface.load(mesh)
    record = run_whole_job(CONFIG, job, nominal, 2, "nominal", calibrated=calibrated)
    assert (record.outcome, record.reason) == ("placed", "")
    return record, summed_up([figures(record, CONFIG, job, nominal)], "nominal")


@pytest.fixture(scope="module")
def single(placed_pot) -> tuple[JobRecord, Run]:
    return placed_pot, summed_up([figures(placed_pot, CONFIG, *pot())], "nominal")


def require_near_what_is_expected(result: Run) -> None:
    """One run is one draw of the calibration: three times what is expected on average is out of reach of chance."""
    for key in ("sensor_scan_mm", "arm_base_mm", "placement_mm"):
        assert 0.0 < result[key]["mean"] < 3.0 * result[key]["bound"]
        assert result[key]["bound"] < LIMITS[key]["mean"]
    assert result["outcomes"]["placed_within_tolerance"] == 1
    assert result["tilt_mrad"]["max"] < LIMITS["tilt_mrad"]["max"]


def test_the_whole_job_at_nominal_is_as_good_as_its_declared_noise(single):
    _, result = single
    require_near_what_is_expected(result)
    assert result["sensor_scan_mm"]["aligned_mean"] < result["sensor_scan_mm"]["mean"]
    assert result["chi2_per_dof"]["calibration"] == pytest.approx(1.0, abs=0.05)
    assert set(result["assumed_noise"]) >= {"arm_repeatability", "arm_dh_length", "speckle_contrast"}


@pytest.mark.campaign
def test_two_sweeps_side_by_side_place_a_part_wider_than_one(single):
    record, result = whole_job("panel", {}, calibrated=single[0])
    require_near_what_is_expected(result)
    made, pose = record.results["reconstruct"], record.results["invert_pose"]
    assert len(made.cloud.each_sweep()) == 2
    (seam,) = made.seams
    assert abs(seam.mean) < 4 * seam.expected_mean and seam.rms < 3 * seam.expected_rms
    # One sweep alone is 36 mm wide and covers 60 % of the panel.
    assert pose.coverage > 0.8
    # Strips that were fitted as they lie would leave 1 mrad: their heights differ by 35 µm over 26 mm.
    assert pose.sigma[3:].max() < 0.25e-3


@pytest.mark.campaign
def test_a_sweep_by_the_arm_alone_places_the_part(single):
    record, result = whole_job("pot", {"mode": "arm"}, calibrated=single[0])
    require_near_what_is_expected(result)
    (swath,) = record.results["laser_sweep"].swaths
    assert np.ptp(swath.rail) == 0.0
    way = np.linalg.norm(swath.flanges[-1, :3, 3] - swath.flanges[0, :3, 3])
    assert way == pytest.approx(0.064, abs=2 * SWEEP_SPEED / 30)


def test_runs_that_end_early_are_counted_with_their_reasons():
    refused = {"seed": 3, "level": "harsh", "outcome": "refused", "reason": "no board", "stage": "calibrate"}
    result = summed_up([refused], "harsh")
    assert (result["outcomes"]["refused"], result["outcomes"]["placed_outside_tolerance"]) == (1, 0)
    assert result["outcomes"]["reasons"] == {"calibrate: no board": 1}
    assert result["placement_mm"]["mean"] is None
    assert "limits" not in result

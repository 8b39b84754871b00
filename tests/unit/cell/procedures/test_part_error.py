"""What a place pose's stated uncertainty means at the part, by closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from cell.procedures.part_error import stated_bound
from lab.bench.job.whole_job import JobRecord
from tests.support.report_runs import pot


def test_the_stated_bound_is_the_closed_form_for_a_round_error(placed_pot: JobRecord):
    job, nominal = pot()
    sigma = 5e-5
    round_error = np.diag([sigma**2] * 3 + [1e-20] * 3)
    pose = replace(placed_pot.results["invert_pose"], covariance=round_error)
    bound = stated_bound(job, nominal, pose, np.zeros((6, 6)))
    for axis in "xyz":
        assert bound[axis] == pytest.approx(1e3 * sigma * norm.ppf(0.975), rel=0.05)
    assert bound["d"] == pytest.approx(1e3 * sigma * np.sqrt(chi2.ppf(0.95, 3)), rel=0.05)
    twice = stated_bound(job, nominal, pose, 3 * round_error)
    assert twice["d"] == pytest.approx(2 * bound["d"], rel=1e-6)


def test_the_bound_is_in_the_surfaces_axes(placed_pot: JobRecord):
    job, nominal = pot()
    found = placed_pot.results["invert_pose"]
    along_x = found.base_from_surface.rotation[:, 0]
    covariance = np.diag([1e-18] * 3 + [1e-20] * 3)
    covariance[:3, :3] += 1e-8 * np.outer(along_x, along_x)
    bound = stated_bound(job, nominal, replace(found, covariance=covariance), np.zeros((6, 6)))
    assert bound["x"] == pytest.approx(0.196, rel=0.05)
    assert max(bound["y"], bound["z"]) < 1e-4

"""Promises of the adjustment: deviations as large as stated over many draws, and misread dots that do no harm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.calibration.solve.adjustment import Adjustment, shared_mask
from cell.measure.calibration.solve.joint import solve_joint, solve_staged, start_state, view_data
from cell.measure.geometry.poses import difference
from tests.unit.cell.measure.calibration.solve.test_results import (
    CAMERA,
    FLANGE_FROM_CAMERA,
    NOMINAL,
    PRIORS,
    RAIL,
    observe,
)


@pytest.mark.parametrize("draws", [4, pytest.param(24, marks=pytest.mark.campaign)])
def test_errors_over_many_draws_are_as_large_as_stated(draws):
    z = []
    for seed in range(20, 20 + draws):
        observations = observe(np.random.default_rng(seed), 12)
        staged = solve_staged(observations, NOMINAL, np.array([1.0, 0, 0]))
        found = solve_joint(observations, staged, PRIORS, held_out=False).adjusted
        sigma, state = np.sqrt(np.diag(found.covariance)), found.state
        z.append(difference(state.flange_from_camera, FLANGE_FROM_CAMERA) / sigma[15:21])
        z.append((state.rail_direction - RAIL) / sigma[12:15])
        z.append((state.camera.parameters - CAMERA.parameters)[:4] / sigma[:4])
        assert 0.8 < found.chi2_per_dof < 1.2
    # 13 correlated values of each draw: their RMS is 1 give or take some tenths.
    assert 0.6 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.5
    assert np.abs(np.concatenate(z)).max() < 4.5


def test_a_robust_fit_survives_a_misread_dot():
    observations = observe(np.random.default_rng(11), 12)
    view = observations[3].view
    pixels = view.pixels.copy()
    pixels[:4] += (1.5, -2.0)
    observations[3] = replace(observations[3], view=replace(view, pixels=pixels))
    staged = solve_staged(observations, NOMINAL)
    views = [view_data(o, r) for o, r in zip(observations, staged.plane.rows, strict=True)]
    found = Adjustment(views, shared_mask(plane=True, rail=True), PRIORS).solve(start_state(staged))
    assert abs(found.state.camera.fx - CAMERA.fx) < 4 * np.sqrt(found.covariance[0, 0]) + 1.0

"""Promises of the adjustment: deviations as large as stated over many draws, and misread dots that do no harm."""

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.calibration.solve.adjustment import Adjustment, shared_mask
from cell.measure.calibration.solve.joint import solve_joint, solve_staged, start_state, view_data
from cell.measure.geometry.poses import difference, from_matrix
from lab.bench.calibration.campaign import observe
from lab.bench.calibration.world import Noise


@pytest.mark.parametrize("draws", [3, pytest.param(24, marks=pytest.mark.campaign)])
def test_errors_over_many_draws_are_as_large_as_stated(world, archived, draws):
    z = []
    for seed in range(20, 20 + draws):
        observations = observe(world, Noise(), np.random.default_rng(seed))
        staged = solve_staged(observations, archived.scan_camera, np.array([1.0, 0, 0]))
        found = solve_joint(observations, staged, archived.priors, held_out=False).adjusted
        sigma, state = np.sqrt(np.diag(found.covariance)), found.state
        z.append(difference(state.flange_from_camera, from_matrix(world.hand)) / sigma[15:21])
        z.append((state.rail_direction - world.rail) / sigma[12:15])
        z.append((state.camera.parameters - world.lens)[:4] / sigma[:4])
        assert 0.8 < found.chi2_per_dof < 1.2
    # 13 correlated values of each draw: their RMS is 1 give or take some tenths.
    assert 0.6 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.5
    assert np.abs(np.concatenate(z)).max() < 4.5


def test_a_robust_fit_survives_a_misread_dot(world, archived):
    observations = list(archived.scan)
    view = observations[3].view
    pixels = view.pixels.copy()
    pixels[:4] += (1.5, -2.0)
    observations[3] = replace(observations[3], view=replace(view, pixels=pixels))
    staged = solve_staged(observations, archived.scan_camera)
    views = [view_data(o, r) for o, r in zip(observations, staged.plane.rows, strict=True)]
    found = Adjustment(views, shared_mask(plane=True, rail=True), archived.priors).solve(start_state(staged))
    assert abs(found.state.camera.fx - world.lens[0]) < 4 * np.sqrt(found.covariance[0, 0]) + 1.0

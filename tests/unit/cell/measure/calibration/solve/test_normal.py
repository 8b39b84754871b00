"""Promises of the normal equations: rests eliminated as in the dense system, derivatives as by finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.calibration.solve.adjustment import shared_mask
from cell.measure.calibration.solve.joint import solve_staged, start_state, view_data
from cell.measure.calibration.solve.normal import (
    COLUMNS,
    OWN,
    SHARED,
    AdjustmentState,
    Normal,
    dots_block,
    stripe_block,
)

RESTS = np.array([0, 1, 1, 1, 2, 3, 3])


def test_rests_are_eliminated_as_the_dense_system_says():
    rng = np.random.default_rng(1)
    free = shared_mask(plane=True, rail=True)
    normal = Normal(RESTS, free, np.ones(OWN, dtype=bool))
    # One column for each unknown there is: the shared ones, six of each rest, one of each view.
    size = SHARED + 6 * 4 + len(RESTS)
    places = [
        np.concatenate([np.arange(SHARED), SHARED + 6 * rest + np.arange(6), [SHARED + 24 + view]])
        for view, rest in enumerate(RESTS)
    ]
    information, right = np.zeros((size, size)), np.zeros(size)
    for view, place in enumerate(places):
        jacobian, residual = rng.normal(size=(40, SHARED + OWN)), rng.normal(size=40)
        normal.add_view("dots", view, jacobian, residual, float(residual @ residual))
        information[np.ix_(place, place)] += jacobian.T @ jacobian
        right[place] += jacobian.T @ residual
    kept = np.concatenate([free, np.ones(24 + len(RESTS), dtype=bool)])
    covariance = np.zeros_like(information)
    covariance[np.ix_(kept, kept)] = np.linalg.inv(information[np.ix_(kept, kept)])
    solution = covariance @ right
    inverse, step = normal.inverse(), normal.step(0.0)
    np.testing.assert_allclose(step[:SHARED], solution[:SHARED], atol=1e-10)
    np.testing.assert_allclose(inverse.shared, covariance[:SHARED, :SHARED], atol=1e-12)
    for view, place in enumerate(places):
        own = place[SHARED:]
        np.testing.assert_allclose(step[SHARED:].reshape(-1, OWN)[view], solution[own], atol=1e-10)
        np.testing.assert_allclose(inverse.cross[view], covariance[np.ix_(np.arange(SHARED), own)], atol=1e-12)
        np.testing.assert_allclose(inverse.own[view], covariance[np.ix_(own, own)], atol=1e-12)
    # The sum of squares falls by what the exact solution takes from it.
    assert normal.promised(step) == pytest.approx(right @ solution, rel=1e-9)


def test_block_jacobians_are_those_of_finite_differences(archived):
    staged = solve_staged(archived.scan, archived.scan_camera)
    view = view_data(archived.scan[0], staged.plane.rows[0])
    state = replace(start_state(staged), flanges=[view.base_from_flange], rails=np.array([0.03]))

    def residuals(step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s: AdjustmentState = state.moved(step)
        dots = dots_block(s, view, s.flanges[0], float(s.rails[0]))[0].ravel()
        return dots, stripe_block(s, view, s.flanges[0], float(s.rails[0]))[0]

    dots = dots_block(state, view, state.flanges[0], 0.03)[1].reshape(-1, COLUMNS)
    stripe = stripe_block(state, view, state.flanges[0], 0.03)[1]
    for k in range(SHARED + OWN):
        size = 1e-3 if k < 4 else 1e-6
        step = np.zeros(SHARED + OWN)
        step[k] = size
        (d_more, s_more), (d_less, s_less) = residuals(step), residuals(-step)
        # The residual is measured minus predicted: its derivative is the negative of the block's.
        most = abs(dots[:, k]).max()
        np.testing.assert_allclose(dots[:, k], -(d_more - d_less) / (2 * size), rtol=1e-4, atol=1e-5 * most)
        np.testing.assert_allclose(stripe[:, k], -(s_more - s_less) / (2 * size), rtol=1e-3, atol=1e-6)

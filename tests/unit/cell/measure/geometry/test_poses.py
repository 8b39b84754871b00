"""Promises of the square root that draws and variants of a calibration are made with."""

from __future__ import annotations

import numpy as np

from cell.measure.geometry.poses import covariance_root


def test_the_columns_make_the_covariance_whatever_the_units():
    rng = np.random.default_rng(2)
    # Pixels beside micrometres, strongly correlated, and one parameter that is known.
    units = np.array([1.0, 1e-2, 1e-4, 3e-6, 0.0, 2e-5])
    mixed = rng.normal(size=(6, 3)) @ rng.normal(size=(3, 6)) + 1e-2 * rng.normal(size=(6, 6))
    covariance = units[:, None] * (mixed @ mixed.T) * units
    root = covariance_root(covariance)
    assert root.shape == (6, 5)
    np.testing.assert_allclose((root @ root.T)[units > 0][:, units > 0], covariance[units > 0][:, units > 0], rtol=1e-9)
    assert not (root @ root.T)[4].any()
    assert covariance_root(np.zeros((3, 3))).shape == (3, 0)

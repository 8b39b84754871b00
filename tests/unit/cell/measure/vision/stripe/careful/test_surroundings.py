"""Promises of `cell.measure.vision.stripe.careful.surroundings`."""

from __future__ import annotations

import numpy as np

from cell.measure.vision.stripe.careful.surroundings import widen_what_departs


def test_edges_ridges_and_clean_lines_keep_their_deviation():
    rng = np.random.default_rng(0)
    row = np.arange(480)
    for line in (0 * row, 30 * (row > 243), 2.0 * (row > 250), 0.3 * abs(row - 243), 20 * np.sin(row / 15)):
        sigma = np.full(480, 0.03)
        widen_what_departs(200 + line + rng.normal(0, 0.03, 480), sigma)
        assert np.count_nonzero(sigma > 0.03) <= 3

"""Promises of `cell.measure.inversion.nominal`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cell.measure.inversion import NominalSurface


def test_closest_points_of_large_triangles_agree_with_a_brute_force_search() -> None:
    vertices = np.array([[0, 0, 0], [0.03, 0, 0], [0.03, 0.02, 0.004], [0, 0.02, 0.001]], dtype=float)
    surface = NominalSurface(vertices, [[0, 1, 2], [0, 2, 3]], rim=0.0)
    s, t = np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 1, 400))
    keep = s + t <= 1
    bary = np.stack([1 - s[keep] - t[keep], s[keep], t[keep]], -1)
    dense = np.concatenate([bary @ vertices[[0, 1, 2]], bary @ vertices[[0, 2, 3]]])
    points = np.random.default_rng(1).uniform([-0.01, -0.01, -0.01], [0.04, 0.03, 0.01], (200, 3))
    _, feet = surface.feet(points)
    exact = np.linalg.norm(points - feet.points, axis=1)
    brute = cKDTree(dense).query(points)[0]
    assert np.all(exact <= brute + 1e-12)
    assert np.all(brute - exact < 5e-5)


def test_the_rim_of_a_large_triangle_is_left_out() -> None:
    corners = [[0.0, 0.0, 0.0], [0.04, 0.0, 0.0], [0.04, 0.04, 0.0], [0.0, 0.04, 0.0]]
    plate = NominalSurface(corners, [[0, 1, 2], [0, 2, 3]])
    found = plate.deviations([[0.02, 0.0003, 1e-4], [0.02, 0.001, 1e-4]])
    assert np.isnan(found[0])
    assert found[1] == pytest.approx(1e-4)

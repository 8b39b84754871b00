"""Promises of `cell.measure.inversion.nominal`."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from cell.config.job import load_job
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.nominal import MOST_SAMPLES, _samples, read_mesh
from drivers.errors import ConfigError

PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n"


def test_closest_points_of_large_triangles_agree_with_a_brute_force_search():
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
    assert np.all(exact <= brute + 1e-12) and np.all(brute - exact < 5e-5)


def test_the_rim_of_a_large_triangle_is_left_out():
    corners = [[0.0, 0.0, 0.0], [0.04, 0.0, 0.0], [0.04, 0.04, 0.0], [0.0, 0.04, 0.0]]
    plate = NominalSurface(corners, [[0, 1, 2], [0, 2, 3]])
    found = plate.deviations([[0.02, 0.0003, 1e-4], [0.02, 0.001, 1e-4]])
    assert np.isnan(found[0])
    assert found[1] == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("corner", "second", "words"),
    [("9 9 0", "0 2 3", ""), ("9 9 0", "0 3 2", "opposite ways"), ("9 9 nan", "0 2 3", "not")],
)
def test_a_mesh_whose_sides_or_corners_are_not_told_is_refused(tmp_path, corner: str, second: str, words: str):
    text = f"property list uchar int vertex_indices\nend_header\n0 0 0\n9 0 0\n{corner}\n0 9 0\n3 0 1 2\n3 {second}\n"
    (tmp_path / "surface.ply").write_text(PLY + text)
    if not words:
        assert read_mesh(tmp_path / "surface.ply", "mm")[0].shape == (4, 3)
        return
    with pytest.raises(ConfigError, match=words):
        read_mesh(tmp_path / "surface.ply", "mm")


def test_a_tube_of_long_thin_triangles_has_no_more_samples_than_another_mesh():
    angle = np.linspace(0.0, np.pi, 33)
    near = 0.02 * np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    far = near + np.array([0.3, 0.0, 0.0])
    strips = (near[:-1], far[:-1], far[1:]), (near[:-1], far[1:], near[1:])
    corners = np.concatenate([np.stack(strip, axis=1) for strip in strips])
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert len(_samples(corners, areas)[0]) < 5 * MOST_SAMPLES


def test_a_mesh_whose_end_is_missing_is_refused(tmp_path):
    whole, cut = tmp_path / "whole.ply", tmp_path / "cut.ply"
    trimesh.load_mesh(load_job("pot")[1], process=False).export(whole, encoding="ascii")
    cut.write_text(whole.read_text()[: -whole.stat().st_size // 10])
    read_mesh(whole, "m")
    with pytest.raises(ConfigError, match=r"cut\.ply is cut: it holds \d+ of 7600 triangles; copy it again"):
        read_mesh(cut, "m")

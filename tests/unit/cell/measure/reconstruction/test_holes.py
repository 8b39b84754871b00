"""Filled holes are as good as they say and never taken for measurements; other programs read what is written."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from cell.measure.reconstruction.cloud import Cloud, merge
from cell.measure.reconstruction.holes import fill_holes
from cell.measure.reconstruction.ply import deviation_colours, read_cloud, triangles, write_cloud, write_mesh
from drivers.errors import ConfigError
from lab.bench.reconstruction.scenes import cut_holes, scene


@pytest.mark.parametrize("surface", ["free-form", "steps"])
@pytest.mark.parametrize("size", [(1, 1), (2, 6), (1, 60)])
def test_an_interpolated_point_errs_as_its_covariance_says(surface: str, size: tuple[int, int]):
    made = scene(surface, "far", 0.0, 5)
    cut = cut_holes(made.depth.shape, size, 150, 6)
    filled = fill_holes(made.cloud(cut)).filled
    asked = cut[filled.lines, filled.rows]
    # Holes that happen to lie side by side are one wider hole, which stays open.
    assert asked.sum() > 0.85 * cut.sum()
    error = filled.points[:, 2] - made.true[filled.lines, filled.rows]
    z = (error / np.sqrt(filled.covariances[:, 2, 2]))[asked]
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.1
    assert np.abs(filled.points[:, 0] - made.x[filled.lines, filled.rows]).max() < 1e-6


def test_a_hole_wider_than_the_limit_stays_a_hole():
    made = scene("free-form", "far", 0.0, 1)
    cut = np.zeros(made.depth.shape, dtype=bool)
    around = np.s_[95:110, 95:125]
    made.depth[around] = made.true[around]
    cut[100:104, 100:120] = True  # 5 × 0.25 mm and 21 × 0.078 mm between its borders
    for largest, expected in ((0.0012, 0), (0.0013, cut.sum()), (0.0, 0)):
        filled = fill_holes(made.cloud(cut), largest).filled
        assert np.count_nonzero(cut[filled.lines, filled.rows]) == expected
    with pytest.raises(ValueError, match="must be 0 or greater"):
        fill_holes(made.cloud(cut), -0.001)


def test_nothing_is_filled_across_a_depth_edge_or_beyond_the_border():
    made = scene("free-form", "far", 0.0, 1)
    made.depth[150:] += 0.0005
    cut = np.zeros(made.depth.shape, dtype=bool)
    cut[149:151, 50:400:20] = True
    cut[:2], cut[:, :3] = True, True
    filled = fill_holes(made.cloud(cut)).filled
    assert len(filled.lines) > 100
    assert not cut[filled.lines, filled.rows].any()


def test_interpolated_points_are_never_measurements():
    made = scene("free-form", "far", 0.0, 1)
    cloud = made.cloud(cut_holes(made.depth.shape, (2, 6), 100, 1))
    whole = fill_holes(cloud)
    assert len(whole.filled.lines) > 1000
    assert whole.size == cloud.size
    lines, rows = whole.subsample(whole.size)
    measured = np.zeros(whole.shape, dtype=bool)
    measured[lines, rows] = True
    assert not measured[whole.filled.lines, whole.filled.rows].any()


def two_sweeps() -> Cloud:
    made = scene("free-form", "far", 0.0, 1)
    whole = made.cloud(cut_holes(made.depth.shape, (2, 6), 40, 1))
    names, parts = ("points", "stripe_spread", "rail_spread", "centres", "rail", "rejected"), []
    for part in (slice(0, 60), slice(100, 160)):
        arrays = {name: getattr(whole, name)[part] for name in names}
        parts.append(fill_holes(replace(whole, **arrays, flanges=np.tile(np.eye(4), (60, 1, 1)))))
    return merge(parts)


def test_a_cloud_is_read_back_with_its_sweeps_its_sigma_and_its_flags(tmp_path):
    cloud = two_sweeps()
    count = write_cloud(tmp_path / "cloud.ply", cloud)
    stored = read_cloud(tmp_path / "cloud.ply")
    assert count == len(stored.points) == cloud.size + len(cloud.filled.lines)
    assert np.count_nonzero(stored.interpolated) == len(cloud.filled.lines) > 100
    lines, rows = np.nonzero(cloud.valid)
    measured = ~stored.interpolated
    assert np.array_equal(stored.line[measured], lines) and np.array_equal(stored.row[measured], rows)
    assert np.array_equal(stored.sweep, stored.line // 60)
    assert np.allclose(stored.points[measured], cloud.points[lines, rows], atol=1e-8)
    assert np.allclose(stored.sigma[measured], cloud.stripe_spread[lines, rows, 2], rtol=1e-6)
    plain = trimesh.load(tmp_path / "cloud.ply")
    assert np.allclose(plain.vertices, stored.points, atol=1e-8)


@pytest.mark.parametrize(
    "content", [b"", b"ply\nend_header\n", b"ply\nelement vertex 3\nproperty float x\nend_header\n"]
)
def test_a_file_that_is_no_cloud_is_refused(tmp_path, content: bytes):
    (tmp_path / "cloud.ply").write_bytes(content)
    with pytest.raises(ConfigError, match="is no cloud of this program"):
        read_cloud(tmp_path / "cloud.ply")
    with pytest.raises(ConfigError, match="did the run come as far"):
        read_cloud(tmp_path / "missing.ply")


def test_a_mesh_lies_on_the_surface_faces_the_camera_and_spans_no_edge(tmp_path):
    made = scene("free-form", "far", 0.0, 1)
    made.depth[150:] += 0.003
    cloud = made.cloud(np.zeros(made.depth.shape, dtype=bool))
    line, row = np.nonzero(cloud.valid & (abs(np.arange(len(made.depth)) - 150) < 30)[:, None])
    points = cloud.points[line, row]
    faces = triangles(points, line, row, np.zeros(len(line), dtype=np.intp))
    assert not ((line[faces] < 150).any(axis=1) & (line[faces] >= 150).any(axis=1)).any()
    # x runs with the lines and y with the rows, so the camera's view is along +z and the normals point to −z.
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(normals[:, 2] < 0)
    flat = -0.5 * normals[:, 2].sum()
    assert flat == pytest.approx(np.ptp(points[:, 0]) * np.ptp(points[:, 1]), rel=0.06)
    for name in ("mesh.ply", "mesh.stl"):
        assert write_mesh(tmp_path / name, points, faces, deviation_colours(points[:, 2], 1e-3)) == len(faces)
        loaded = trimesh.load(tmp_path / name)
        assert len(loaded.faces) == len(faces)
        assert np.ptp(loaded.vertices, axis=0) == pytest.approx(np.ptp(points[faces].reshape(-1, 3), axis=0), abs=1e-6)
    with pytest.raises(ValueError, match="no neighbours"):
        triangles(points[:1], line[:1], row[:1], np.zeros(1, dtype=np.intp))

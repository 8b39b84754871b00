"""Promises of `cell.measure.reconstruction.ply`."""

import numpy as np
import pytest
import trimesh

from cell.measure.reconstruction.ply import deviation_colours, read_cloud, write_ply
from drivers.errors import ConfigError


def test_a_ply_is_read_back_by_another_library(tmp_path):
    points = np.random.default_rng(1).normal(size=(12, 40, 3))
    points[3, 10:20] = np.nan
    colours = deviation_colours(points[:, :, 2], 1e-4)
    path = tmp_path / "cloud.ply"
    count = write_ply(path, points, quality=points[:, :, 2], colours=colours, comment="frame: arm base")
    kept = np.isfinite(points[:, :, 0])
    assert count == kept.sum()
    loaded = trimesh.load(path)
    assert np.allclose(loaded.vertices, points[kept], atol=1e-6)
    assert np.array_equal(loaded.colors[:, :3], colours[kept])
    header = path.read_bytes().split(b"end_header")[0].decode()
    for line in ("format binary_little_endian 1.0", "comment coordinates in metres", "comment frame: arm base"):
        assert line in header.splitlines()
    assert path.stat().st_size == len(header) + len("end_header\n") + count * (4 * 4 + 3)


def test_a_ply_with_columns_of_different_length_is_refused(tmp_path):
    with pytest.raises(ValueError, match="quality has 3 values for 2 points"):
        write_ply(tmp_path / "x.ply", np.zeros((2, 3)), quality=np.zeros(3))


def test_deviation_colours_run_from_blue_over_green_to_red():
    colours = deviation_colours([-1.0, -0.001, 0.0, 0.001, np.nan], 0.001)
    assert colours.tolist() == [[0, 0, 255], [0, 0, 255], [0, 255, 0], [255, 0, 0], [128, 128, 128]]
    with pytest.raises(ValueError, match="greater than 0"):
        deviation_colours([0.0], 0.0)


@pytest.mark.parametrize("count", ["abcd", "-1", "3"])
def test_a_cloud_whose_header_is_spoilt_is_refused(tmp_path, count: str):
    names = ("x", "y", "z", "sigma", "line", "row", "sweep", "interpolated", "x")
    kinds = "".join(f"property float {name}\n" for name in names)
    (tmp_path / "cloud.ply").write_text(f"ply\nelement vertex {count}\n{kinds}end_header\n{'0000' * 27}")
    with pytest.raises(ConfigError, match="is no cloud of this program"):
        read_cloud(tmp_path / "cloud.ply")

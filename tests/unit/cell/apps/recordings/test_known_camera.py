"""Promise: a camera from a file is read as it was meant, or refused with key, value and next step."""

import cv2
import numpy as np
import pytest

from cell.apps.recordings.known_camera import read_camera
from cell.apps.recordings.solution import camera_of
from cell.base.storage import sealed, write_json
from cell.measure.calibration.solve.intrinsics import choose_lens
from cell.measure.geometry.camera import CameraModel
from drivers.errors import ConfigError, RefusedError
from tests.support import recorded_scenes
from tests.support.recorded_scenes import LENS, MATRIX, SIZE, right, scene, solved

SENSIBLE = CameraModel(1280, 960, 1400, 1400, 650, 470)


def file_of(folder, model: str, lens: str, matrix: str = "1400, 0, 650, 0, 1410, 470, 0, 0, 1"):
    path = folder / "camera.yaml"
    path.write_text(
        f"image_width: 1280\nimage_height: 960\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [{matrix}]\n"
        f"distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{lens}]\n"
    )
    return path


@pytest.mark.parametrize("lens", ["-0.1, 0.05, 0.001, -0.001, 0.2", "-0.1, 0.05, 0.001, -0.001, 0.2, 0, 0, 0"])
@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial"])
def test_the_plain_model_is_read(tmp_path, model, lens):
    camera = read_camera(file_of(tmp_path, model, lens))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (1400, 1410, 650, 470)
    assert camera.dist == (-0.1, 0.05, 0.001, -0.001, 0.2)


@pytest.mark.parametrize("name", ["distortion", "coeffs", "dist", "D", "dist_coeffs"])
def test_a_lens_in_a_list_beside_focal_lengths_by_name_is_read(tmp_path, name):
    path = tmp_path / "camera.json"
    camera = {"width": 1280, "height": 960, "fx": 1400.0, "fy": 1410.0, "cx": 650.0, "cy": 470.0}
    write_json(path, {**camera, name: [-0.1, 0.05, 0.001, -0.001, 0.2]})
    assert read_camera(path).dist == (-0.1, 0.05, 0.001, -0.001, 0.2)
    write_json(path, {**camera, name: [0.0, 0.0, 0.0, 0.0, 0.0, 0.5]})
    with pytest.raises(ConfigError, match=rf"{name}\[5\] is 0.5"):
        read_camera(path)


@pytest.mark.parametrize(
    ("model", "lens", "words"),
    [
        ("rational_polynomial", "0.5, 0.1, 0, 0, 0.02, 0.62, 0.2, 0.05", r"distortion_coefficients\[5\] is 0.62"),
        ("equidistant", "-0.05, 0.02, -0.01, 0.003", "distortion_model is equidistant"),
        ("fisheye", "-0.05, 0.02, -0.01, 0.003", "distortion_model is fisheye"),
        ("plumb_bob", "0.1", "distortion_coefficients has 1 numbers"),
        ("plumb_bob", ".nan, 0, 0, 0, 0", "k1 is nan"),
    ],
)
def test_other_lenses_are_refused_by_name(tmp_path, model, lens, words):
    with pytest.raises(ConfigError, match=words) as refused:
        read_camera(file_of(tmp_path, model, lens))
    assert "--camera out" in str(refused.value)


def test_a_result_that_was_edited_after_it_was_written_is_refused(tmp_path):
    path = tmp_path / "result.json"
    lens = {"fx": 1400.0, "fy": 1410.0, "cx": 650.0, "cy": 470.0}
    write_json(path, sealed({"intrinsics": {"width": 1280, "height": 960, **lens}}))
    assert read_camera(path).fx == 1400.0
    path.write_text(path.read_text().replace("1400.0", "1401.0"))
    with pytest.raises(ConfigError, match="was changed after `cell calibrate --from` wrote it"):
        read_camera(path)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ("-1400, 0, 650, 0, 1410, 470, 0, 0, 1", "fx is -1400 px, allowed are 128"),
        ("1400, 0, 650, 0, 0, 470, 0, 0, 1", "fy is 0 px"),
        ("1400, 0, 6500, 0, 1410, 470, 0, 0, 1", "cx is 6500 px"),
        ("1.4, 0, 0.65, 0, 1.41, 0.47, 0, 0, 1", "fx is 1.4 px"),
        ("1400, 3, 650, 0, 1410, 470, 0, 0, 1", "camera_matrix is"),
    ],
)
def test_a_matrix_that_is_no_camera_is_refused(tmp_path, matrix, words):
    with pytest.raises(ConfigError, match=words):
        read_camera(file_of(tmp_path, "plumb_bob", "0, 0, 0, 0, 0", matrix))


@pytest.mark.parametrize(
    "text", ['{"width": Infinity}', "[" * 3000, '{"model": [], "image_width": 1, "image_height": 1}']
)
def test_a_file_of_senseless_numbers_is_refused_in_words(tmp_path, text):
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(ConfigError, match="--camera"):
        read_camera(tmp_path / "camera.json")


VISP = """<?xml version="1.0"?><root><camera><name>Camera</name>
<image_width>1280</image_width><image_height>960</image_height>
<model><type>perspectiveProjWithoutDistortion</type><px>1380</px><py>1390</py><u0>650</u0><v0>470</v0></model>
<model><!--lens--><type>perspectiveProjWithDistortion</type>
<px>1400</px><py>1410</py><u0>650</u0><v0>470</v0><kud>-0.1</kud><kdu>0.11</kdu></model>
</camera></root>"""


@pytest.mark.parametrize("kind", ["camera.xml", "camera.yml", "camera.json", "visp.xml"])
def test_files_of_opencv_and_visp_are_read(tmp_path, kind):
    """Written by OpenCV itself, sizes and lens under the names of its own sample."""
    path = tmp_path / kind
    lens = (-0.1, 0.0, 0.0, 0.0, 0.0) if kind.startswith("visp") else (-0.1, 1e-05, 0.001, -0.001, 0.2)
    if kind.startswith("visp"):
        path.write_text(VISP)
    else:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, value in (("calibration_time", "Mon"), ("image_width", 1280), ("image_height", 960)):
            storage.write(name, value)
        storage.write("camera_matrix", np.array([[1400.0, 0, 650], [0, 1410, 470], [0, 0, 1]]))
        storage.write("distortion_coefficients", np.array([lens]).T)
        storage.release()
    camera = read_camera(path)
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx) == (1280, 960, 1400, 1410, 650)
    assert camera.dist == lens


def test_a_given_camera_without_pictures_is_refused():
    with pytest.raises(RefusedError, match="no picture shows the board"):
        camera_of([], SENSIBLE)


def given(fx: float = 1.0, cx: float = 0.0) -> CameraModel:
    return CameraModel(*SIZE, fx * MATRIX[0, 0], fx * MATRIX[1, 1], MATRIX[0, 2] + cx, MATRIX[1, 2], tuple(LENS))


@pytest.mark.parametrize("wrong", [given(fx=1.03), given(cx=25.0)])
def test_the_file_of_another_camera_is_refused_with_all_that_rests_on_it(wrong):
    result = solved(scene(laser=False), wrong)
    assert "given camera against that of the pictures" in result["refused"]["intrinsics"]
    assert result["hand_eye"] is None
    assert all(result[name] is None for name in result if name.startswith("intrinsics"))
    assert result["refused_values"]["intrinsics_from_pictures"]["fx"] == wrong.fx


@pytest.mark.parametrize("off", [1.0, 1.003, 0.99])
def test_what_a_given_camera_is_off_by_is_stated_or_refused(off):
    result = solved(scene(seed=7, count=6, laser=False), given(fx=off))
    assert right(result)
    if off == 1.0:
        assert not result["refused"]
        # By the pictures alone it is 1.5 mm; that they agree with the file makes it known no better than both allow.
        assert 1.1 < np.linalg.norm(result["hand_eye"]["sigma_mm"]) < 1.4


def test_a_given_camera_that_nothing_checks_is_doubted_and_has_a_deviation():
    result = solved(scene(seed=3, count=3), given(fx=1.01))
    assert result["intrinsics"]["sigma_px"]["fx"] > 0.009 * MATRIX[0, 0]
    assert any("not checked" in note and "3 stops" in note for note in result["notes"])
    assert right(result)
    assert result["light_plane"]["sigma_place_mm"] > 0.1


@pytest.mark.parametrize("seed", [0, 2])
def test_a_lens_off_its_axis_counts_in_a_camera_of_few_views(monkeypatch, seed):
    """Eight views cannot tell tangential terms for certain; held at 0 they move the centre by ten deviations."""
    monkeypatch.setattr(recorded_scenes, "LENS", np.array([-0.1, 0.05, 0.003, -0.002, 0.0]))
    found, _ = choose_lens([frame.view for frame in scene(seed, count=8, laser=False)])
    truth = np.array([MATRIX[0, 0], MATRIX[1, 1], MATRIX[0, 2], MATRIX[1, 2]])
    assert np.all(np.abs(found.camera.parameters[:4] - truth) < 3 * found.sigma[:4])
    assert np.all(found.sigma[:4] < 0.012 * MATRIX[0, 0])

"""Promises of `cell calibrate --from` on recordings: what it prints, when it fails, and where a camera is mounted."""

import ast
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.apps.cli.app import app
from cell.apps.cli.calibration.calibrate import verdicts
from cell.apps.recordings.command import calibrate_folder
from cell.measure.vision.board.view import parse_board
from drivers.errors import ConfigError
from tests.support.recorded_scenes import recording

pytestmark = pytest.mark.recorded


def calibrate(folder: Path, *options: str):
    return CliRunner().invoke(app, ["calibrate", "--from", str(folder), *options])


def test_the_dot_board_gives_the_published_camera_as_json_without_nan():
    ran = calibrate(recording("dot_board"), "--board", "dots:6x6:34mm", "--json")
    assert ran.exit_code == 0, ran.output

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    dot_board = json.loads(ran.stdout, parse_constant=refuse)
    assert dot_board["board"] == "dots:6x6:34mm"
    assert sum(f["used"] for f in dot_board["frames"]) == 5
    assert all(f["order_assumed"] for f in dot_board["frames"])
    camera = dot_board["intrinsics_without_distortion"]
    assert camera["rms_px"] < 0.33
    assert camera["fx"] == pytest.approx(276.509794, rel=0.01)
    assert camera["fy"] == pytest.approx(272.959474, rel=0.01)
    assert camera["cx"] == pytest.approx(163.865226, abs=1.0)
    assert camera["cy"] == pytest.approx(113.304585, abs=1.0)


def test_people_get_tables_with_units(tmp_path):
    for number in (1, 2, 3):
        shutil.copy(recording("dot_board") / f"circles-{number:02d}.jpg", tmp_path)
    ran = calibrate(tmp_path, "--board", "dots:6x6:34mm")
    assert ran.exit_code == 0, ran.output
    lines = ran.stdout.splitlines()
    assert lines[0] == "3 of 3 used"
    assert [line.split(":")[0] for line in lines[1:4]] == ["camera", "hand-eye", "light plane"]
    assert re.search(r"fx [\d.]+ ± [\d.]+, .* px; used; ", lines[1])
    assert "circles-03.jpg" in calibrate(tmp_path, "--board", "dots:6x6:34mm", "--laser", "none", "--details").stdout


def test_another_board_than_that_in_the_pictures_is_an_error(tmp_path):
    shutil.copy(recording("dot_board") / "circles-01.jpg", tmp_path)
    ran = calibrate(tmp_path, "--board", "dots:9x7:34mm", "--json")
    assert isinstance(ran.exception, ConfigError)
    assert "is dots:9x7:34mm the board in the pictures" in str(ran.exception)
    assert json.loads(ran.stdout)["frames"][0]["reason"] == "no_board"


def test_too_few_pictures_are_an_error_that_says_how_many_are_needed(tmp_path):
    for number in (1, 2):
        shutil.copy(recording("dot_board") / f"circles-{number:02d}.jpg", tmp_path)
    ran = calibrate(tmp_path, "--board", "dots:6x6:34mm", "--json")
    assert isinstance(ran.exception, ConfigError)
    assert "needs 3 or more" in str(ran.exception)


def test_a_pose_without_a_picture_is_named(tmp_path):
    for name in ("frame0002.png", "pose0002.txt", "pose0003.txt"):
        shutil.copy(recording("robot_line_laser") / name, tmp_path)
    notes = calibrate_folder(tmp_path, parse_board("chessboard:7x6:10mm")).notes
    assert any("pose0003.txt" in note for note in notes)


@pytest.mark.campaign
def test_two_frames_with_poses_of_elsewhere_do_not_hide_each_other(tmp_path):
    for path in recording("robot_line_laser").iterdir():
        shutil.copy(path, tmp_path)
    for number, shift in ((5, 0.006), (8, 0.05)):
        path = tmp_path / f"pose{number:04d}.txt"
        (x, *rest), turn = ast.literal_eval(path.read_text())
        path.write_text(str(((x + shift, *rest), turn)))
    frames = calibrate_folder(tmp_path, parse_board("chessboard:7x6:10mm")).frames
    assert [f["name"] for f in frames if not f["used"]] == ["frame0005.png", "frame0008.png"]


def test_inverted_pairs_are_recognised_as_a_camera_on_the_flange(tmp_path):
    pairs = json.loads((recording("hand_eye") / "pose_samples.json").read_text())
    inverted = [[np.linalg.inv(flange).tolist(), board] for flange, board in pairs]
    (tmp_path / "pose_samples.json").write_text(json.dumps(inverted))
    hand_eye = calibrate_folder(tmp_path, None).hand_eye
    assert hand_eye["setup"] == "eye_in_hand"
    np.testing.assert_allclose(hand_eye["translation_mm"], (659, -249, 830), rtol=0.01)


def test_the_recorded_pairs_give_the_published_hand_eye():
    hand_eye = calibrate_folder(recording("hand_eye"), None).hand_eye
    assert hand_eye["setup"] == "eye_to_hand"
    np.testing.assert_allclose(hand_eye["translation_mm"], (659, -249, 830), rtol=0.01)
    published = np.array([0.230, -2.540, 1.950])
    assert np.linalg.norm(hand_eye["euler_xyz_rad"] - published) < 0.01 * np.linalg.norm(published)


def test_refused_values_are_shown_and_marked():
    check = {"part": "hand_eye", "verdict": "refused", "text": "hand-eye: too far off"}
    value = {"setup": "eye_in_hand", "translation_mm": [1, 2, 3], "sigma_mm": [4, 5, 6], "sigma_deg": [0.1, 0.2, 0.3]}
    none = dict.fromkeys(("intrinsics", "hand_eye", "light_plane"))
    result = {**none, "checks": [check], "notes": ["no light plane: dark"], "refused_values": {"hand_eye": value}}
    camera, hand, plane = verdicts({**result, "refused": {"hand_eye": check["text"]}})
    assert hand.startswith("hand-eye: REFUSED (do not use: eye in hand, x 1.00 ± 4.00, y 2.00 ± 5.00")
    assert hand.endswith("too far off")
    assert plane == "light plane: none: no light plane: dark"
    assert camera == "camera: none: not asked for"

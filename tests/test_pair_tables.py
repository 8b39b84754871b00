"""Promise: two tables of poses without pictures give the hand-eye, whatever their convention, or the reason why not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from cell.calibration.recorded.attach import Options
from cell.calibration.recorded.command import calibrate_folder
from cell.calibration.recorded.pair_tables import goes_inverse
from cell.cli.app import app
from drivers.errors import ConfigError, RefusedError
from tests.recorded_scenes import FLANGE_FROM_CAMERA, scene
from tests.test_stops import given_pairs

PAIRS = given_pairs(scene(count=10, laser=False))


def rows(poses: list[pin.SE3], turn: Callable[[Rotation], np.ndarray], unit: float = 1.0) -> str:
    """A line for each pose: its position in a unit of so many per m, then its turn."""
    return "".join(
        ",".join(f"{v:.8f}" for v in [*(unit * p.translation), *turn(Rotation.from_matrix(p.rotation))]) + "\n"
        for p in poses
    )


def degrees(turn: Rotation) -> np.ndarray:
    return turn.as_euler("xyz", degrees=True)


def test_degrees_in_mm_and_rotation_vectors_in_m_are_told_apart(tmp_path):
    (tmp_path / "end2base.csv").write_text(rows([f for f, _ in PAIRS], degrees, 1e3))
    (tmp_path / "board2cam.csv").write_text(rows([b for _, b in PAIRS], Rotation.as_rotvec))
    result = calibrate_folder(tmp_path, None)
    assert not result["refused"]
    assert result["poses"]["reading"] == "xyz+rpy-deg"
    assert "rotation vector, in rad in m, camera_from_board" in result["poses"]["text"]
    found, sigma = result["hand_eye"], np.array(result["hand_eye"]["sigma_mm"])
    assert found["setup"] == "eye_in_hand"
    assert np.all(np.abs(np.array(found["translation_mm"]) - 1e3 * FLANGE_FROM_CAMERA.translation) < 4 * sigma + 0.05)


@pytest.mark.parametrize(
    ("name", "inverse"),
    [
        *[(name, True) for name in ("cam2board", "T_board_cam", "cameraToBoard", "camera_in_board", "cam_wrt_target")],
        *[(name, False) for name in ("board2cam", "T_cam_board", "cam_T_board", "target2cam", "camera_from_board")],
        *[(name, None) for name in ("camera_board_poses", "board_poses", "chessboard_camera")],
    ],
)
def test_which_way_a_table_goes_is_told_by_its_name_or_not_at_all(name, inverse):
    assert goes_inverse(f"{name}.csv") is inverse


@pytest.mark.parametrize("name", ["cam2board.txt", "T_board_from_camera.txt"])
def test_poses_of_the_camera_in_the_board_are_turned_round(tmp_path, name):
    (tmp_path / "robot.txt").write_text(rows([f for f, _ in PAIRS], Rotation.as_quat))
    (tmp_path / name).write_text(rows([b.inverse() for _, b in PAIRS], Rotation.as_quat))
    result = calibrate_folder(tmp_path, None)
    assert "board_from_camera" in result["poses"]["text"]
    assert np.linalg.norm(np.array(result["hand_eye"]["translation_mm"]) - 1e3 * FLANGE_FROM_CAMERA.translation) < 1.0


def test_a_board_of_another_size_is_refused(tmp_path):
    (tmp_path / "robot.txt").write_text(rows([f for f, _ in PAIRS], Rotation.as_quat))
    (tmp_path / "board2cam.txt").write_text(rows([b for _, b in PAIRS], Rotation.as_quat, 1.2))
    result = calibrate_folder(tmp_path, None)
    assert "times as large" in result["refused"]["hand_eye"]
    assert result["hand_eye"] is None


def test_rows_that_do_not_belong_together_are_refused(tmp_path):
    (tmp_path / "robot.txt").write_text(rows([f for f, _ in PAIRS], Rotation.as_quat))
    (tmp_path / "board2cam.txt").write_text(rows([b for _, b in PAIRS[::-1]], Rotation.as_quat))
    with pytest.raises(RefusedError, match="no reading of the poses agrees"):
        calibrate_folder(tmp_path, None)


@pytest.mark.parametrize(
    ("names", "words"),
    [(("a.txt", "b.txt"), "board_poses.csv"), (("robot.txt", "arm.txt"), "board_poses.csv"), (("robot.txt",), "robot")],
)
def test_tables_whose_names_do_not_tell_are_asked_for(tmp_path, names, words):
    for name in names:
        (tmp_path / name).write_text(rows([f for f, _ in PAIRS], Rotation.as_quat))
    with pytest.raises(ConfigError, match=words):
        calibrate_folder(tmp_path, None)


def test_tables_of_different_lengths_are_refused_with_both_counts(tmp_path: Path):
    (tmp_path / "robot.txt").write_text(rows([f for f, _ in PAIRS], Rotation.as_quat))
    (tmp_path / "board2cam.txt").write_text(rows([b for _, b in PAIRS[1:]], Rotation.as_quat))
    with pytest.raises(ConfigError, match=r"10 poses and .* 9"):
        calibrate_folder(tmp_path, None)


def test_the_plan_says_how_they_were_read_and_no_more(tmp_path):
    (tmp_path / "robot.txt").write_text(rows([f for f, _ in PAIRS], Rotation.as_quat))
    (tmp_path / "board2cam.txt").write_text(rows([b for _, b in PAIRS], Rotation.as_quat))
    result = calibrate_folder(tmp_path, None, Options(plan=True))
    assert result["hand_eye"] is None
    assert result["poses"]["reading"] == "xyz+quaternion-xyzw"


def test_a_camera_far_from_the_flange_is_doubted(tmp_path):
    """A standing camera with inverse poses looks like one that rides on the flange, a metre and more away from it."""
    base_from_camera = pin.SE3(FLANGE_FROM_CAMERA.rotation, np.array([1.2, 0.3, 0.9]))
    flange_from_board = pin.SE3(np.eye(3), np.array([0.02, 0.0, 0.1]))
    flanges = [base_from_camera * board * flange_from_board.inverse() for _, board in PAIRS]
    (tmp_path / "robot.txt").write_text(rows([f.inverse() for f in flanges], Rotation.as_quat))
    (tmp_path / "board2cam.txt").write_text(rows([b for _, b in PAIRS], Rotation.as_quat))
    notes = calibrate_folder(tmp_path, None)["notes"]
    assert any("1.53 m away" in note and "invert" in note for note in notes)


def test_people_are_told_how_the_tables_were_read_and_which_rows_are_not_used(tmp_path):
    flanges = [f for f, _ in PAIRS]
    flanges[2], flanges[7] = flanges[7], flanges[2]
    (tmp_path / "robot.txt").write_text(rows(flanges, Rotation.as_quat))
    (tmp_path / "board2cam.txt").write_text(rows([b for _, b in PAIRS], Rotation.as_quat))
    ran = CliRunner().invoke(app, ["calibrate", "--from", str(tmp_path)])
    assert ran.exit_code == 0, ran.output
    assert "quaternion xyzw" in ran.stdout
    assert "evidence" in ran.stdout
    assert all(f"pair {k} not used" in ran.stdout for k in (2, 7))

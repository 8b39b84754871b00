"""Figures of a picture of a board, and the words and TOML for what a camera has shown."""

import math
import tomllib

import cv2
import numpy as np
import pinocchio as pin
import pytest

from cell.apps.commission.check import Result
from cell.apps.commission.checks.cameras import picture_figures, pose_toml, pose_words, renamed
from cell.apps.commission.measuring import Eye
from cell.config.cell_config import load_config
from cell.measure.geometry.poses import from_parts
from cell.measure.vision.board.view import parse_board


def figures(image: np.ndarray) -> set[str]:
    """Which figures of a picture of a board are outside their limits."""
    config, result = load_config(None), Result()
    eye = Eye(
        "scan_camera", config.scan_camera, config.calibration.fine, key="calibration.fine", depth=0.13, step=0.005
    )
    picture_figures(result, image, np.array([[20.0, 20.0], [219.0, 179.0]]), eye)
    return {row.what for row in result.readings if not row.ok}


def test_light_and_focus_are_judged_by_the_board_alone():
    board = np.full((200, 240), 200, np.uint8)
    for x in range(40, 220, 25):
        for y in range(40, 180, 25):
            cv2.circle(board, (x, y), 8, 60, -1, cv2.LINE_AA)
    board[:15] = 255
    assert figures(board) == set()
    assert figures(cv2.GaussianBlur(board, (0, 0), 8.0)) == {"width of an edge in the picture"}
    assert "brightness of the board" in figures(board // 5)
    assert "saturated pixels" in figures(np.clip(board.astype(int) + 80, 0, 255).astype(np.uint8))
    assert "contrast of the board" in figures(np.full_like(board, 120))


@pytest.mark.parametrize(
    ("times", "name"), [(1.25, "marked_dots:9x7:25mm"), (1.201, "marked_dots:9x7:24mm"), (1.0, "marked_dots:9x7:20mm")]
)
def test_a_board_of_another_size_is_named_by_a_pitch_that_is_made(times: float, name: str):
    assert renamed(parse_board("marked_dots:9x7:20mm"), times) == name


def test_a_pose_is_told_and_written_in_millimetres_and_degrees():
    pose = from_parts((0.0901, -0.05, 0.08), pin.rpy.rpyToMatrix(0.0, 0.0, math.radians(90.0)))
    assert pose_words(pose) == "(90.1, -50, 80) mm, (0, 0, 90) deg"
    told = tomllib.loads(f"pose = {pose_toml(pose)}")["pose"]
    assert told == {"translation": ["90.1 mm", "-50 mm", "80 mm"], "rotation": ["0 deg", "0 deg", "90 deg"]}

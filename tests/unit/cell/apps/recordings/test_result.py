"""Promises on what is printed of a hand-eye: its angles, and what the poses cannot tell."""

import json

import cv2
import numpy as np
import pinocchio as pin
import pytest

from cell.apps.recordings.pairs import calibrate_pairs
from cell.apps.recordings.result import hand_eye_figures
from tests.support.recorded_scenes import given_pairs, scene


@pytest.mark.parametrize("angles", [(0.23, -2.54, 1.95), (2.9, 0.4, -3.0), (1.0, 1.2, 0.5)])
def test_the_angles_are_about_x_the_new_y_and_the_new_z(angles):
    about = [cv2.Rodrigues(np.eye(3)[axis] * angle)[0] for axis, angle in enumerate(angles)]
    pose = pin.SE3(about[0] @ about[1] @ about[2], np.array([0.1, 0.2, 0.3]))
    figures = hand_eye_figures("eye_in_hand", "", pose, (0.0, 0.0))
    np.testing.assert_allclose(figures["euler_xyz_rad"], angles, atol=1e-9)
    np.testing.assert_allclose(figures["translation_mm"], (100, 200, 300))


def test_inverse_poses_are_a_camera_that_stands_still_and_that_is_said():
    result = calibrate_pairs([(flange.inverse(), board) for flange, board in given_pairs(scene(laser=False))])
    told = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert told["hand_eye"]["setup"] == "eye_to_hand"
    assert any("inverse" in note for note in told["notes"])

"""Promises on what poses may mean: the reading that agrees with the pictures is taken, or the choice is asked for."""

import json

import numpy as np
import pytest

from drivers.errors import ConfigError
from tests.unit.cell.apps.recordings.pictures import (
    BASE_FROM_BOARD,
    FLANGE_FROM_CAMERA,
    POSES,
    one_file_each,
    quaternion,
    row,
    tuples,
    understand,
)


def test_a_camera_that_stands_before_the_arm_is_recognised(recording, seen):
    one_file_each(recording, lambda p: row(np.linalg.inv(p).ravel()))
    _, understood, _ = understand(recording, seen)
    assert understood.setup == "eye_to_hand"
    assert "eye in hand" in understood.about["evidence"]


def test_two_fields_that_both_agree_are_asked_for(recording, seen):
    tool = np.eye(4)
    tool[:3, 3] = 0, 0.02, 0.15
    both = [
        {"file": f"frame{k + 3:02d}.png", "flange": p.tolist(), "tcp": (p @ tool).tolist()} for k, p in enumerate(POSES)
    ]
    (recording / "both.json").write_text(json.dumps(both))
    frames, understood, _ = understand(recording, seen)
    assert "--pose-field" in understood.refused
    assert all(f.base_from_flange is None for f in frames)
    (name,) = [w.rstrip(";,") for w in understood.refused.split() if w.startswith("both.json") and "flange" in w]
    frames, understood, _ = understand(recording, seen, pose_field=name)
    assert np.abs(frames[0].base_from_flange.homogeneous - POSES[0]).max() < 1e-6
    with pytest.raises(ConfigError, match="no such poses"):
        understand(recording, seen, pose_field="tcp2")


def boards_poses(turned: bool) -> list[np.ndarray]:
    """camera_from_board of each view, or its inverse, as somebody's detector gave them."""
    poses = [np.linalg.inv(FLANGE_FROM_CAMERA) @ np.linalg.inv(p) @ BASE_FROM_BOARD for p in POSES]
    return [np.linalg.inv(p) if turned else p for p in poses]


@pytest.mark.parametrize("turned", [False, True])
def test_the_boards_poses_beside_the_pictures_are_not_taken_for_the_flanges(recording, seen, turned):
    # They agree with the pictures better than any arm's.
    for k, pose in enumerate(boards_poses(turned)):
        (recording / f"board{k + 3:02d}.txt").write_text(row(np.r_[1.03 * pose[:3, 3], quaternion(pose)]))
    _, alone, _ = understand(recording, seen)
    assert "those of the board as the camera sees it" in alone.refused
    tuples(recording)
    frames, understood, _ = understand(recording, seen)
    assert not understood.refused
    assert "boardN.txt not used: its poses are those of the board" in " ".join(understood.notes)
    assert understood.about["source"] == ["poseN.txt"]
    assert all(np.abs(f.base_from_flange.homogeneous - p).max() < 1e-6 for f, p in zip(frames, POSES, strict=True))


def test_a_wrong_pitch_is_named_with_the_right_one(recording, seen):
    one_file_each(recording, lambda p: row(np.vstack([np.c_[p[:3, :3], 1.25 * p[:3, 3]], p[3:]]).ravel()))
    frames, understood, _ = understand(recording, seen)
    assert "25.0" in understood.refused
    assert all(f.base_from_flange is None for f in frames)


def test_poses_of_other_pictures_agree_in_no_reading(recording, seen):
    for k, pose in enumerate(POSES[::-1]):
        (recording / f"pose{k + 3:02d}.txt").write_text(row(pose.ravel()))
    _, understood, _ = understand(recording, seen)
    assert "are they the poses of these pictures" in understood.refused

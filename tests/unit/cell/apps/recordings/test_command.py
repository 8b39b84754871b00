"""Promises on a folder as a whole: what is asked, what is told of each picture and of copies."""

import cv2
import pytest

from cell.apps.recordings.command import Options, attach_poses, calibrate_folder
from cell.apps.recordings.frames import read_frames
from drivers.errors import ConfigError
from tests.unit.cell.apps.recordings.pictures import (
    BOARD,
    CAMERA,
    POSES,
    matched,
    one_file_each,
    quaternion,
    row,
    tuples,
    understand,
)


def test_one_pose_in_another_unit_is_named(recording, seen):
    one_file_each(recording, lambda p: row([*p[:3, 3], *quaternion(p)]))
    p = POSES[4]
    (recording / "pose07.txt").write_text(row([*(1e3 * p[:3, 3]), *quaternion(p)]))
    frames, understood, _ = understand(recording, seen)
    assert not understood.refused, understood.refused
    assert "pose07.txt" in frames[4].text and "another unit" in frames[4].text
    others = [f for f in frames if f is not frames[4]]
    assert all(f.reason is None and f.base_from_flange is not None for f in others)


def test_a_plan_says_how_poses_are_read_and_calibrates_nothing(recording):
    tuples(recording)
    plan = calibrate_folder(recording, BOARD, Options(plan=True)).as_dict()
    assert (plan["poses"]["reading"], plan["intrinsics"]) == ("xyz+quaternion-xyzw", None)
    assert plan["poses"]["turn_deg"] < 0.2


def test_without_a_board_the_folders_with_pictures_are_named(tmp_path, pictures):
    (tmp_path / "left").symlink_to(pictures)
    with pytest.raises(ConfigError, match=r"8 pictures with --board.*pictures are in left \(8\)"):
        calibrate_folder(tmp_path, None)


def test_a_copy_under_another_number_counts_once_and_with_another_pose_it_is_refused(recording):
    (recording / "frame11.png").symlink_to(recording / "frame03.png")
    image = cv2.imread(str(recording / "frame04.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(recording / "frame12.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    (recording / "frame13.png").symlink_to(recording / "frame05.png")
    rows = [row(p.ravel()) for p in [*POSES, POSES[0], POSES[1], POSES[7]]]
    (recording / "poses.txt").write_text("\n".join(rows))
    listing, belonging, links, _ = matched(recording)
    frames, _ = read_frames(listing, BOARD, links)
    attach_poses(frames, belonging, CAMERA, Options())
    assert [f.reason for f in frames[: len(POSES)]] == [None] * len(POSES)
    same, again, other = frames[len(POSES) :]
    assert (same.reason.value, same.text) == ("duplicate", "the same file as frame03.png")
    assert (again.reason.value, again.text) == ("duplicate", "it shows what frame04.png shows")
    assert other.reason.value == "no_pose"
    assert "frame05.png" in other.text

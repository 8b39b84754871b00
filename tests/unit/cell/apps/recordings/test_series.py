"""Promises on which pose belongs to which picture, and on what lies in a folder."""

import json

import cv2
import numpy as np
import pytest

from cell.apps.recordings.command import Options, attach_poses
from cell.apps.recordings.frames import RecordedFrame, read_frames
from cell.apps.recordings.series import in_order_of_views, list_folder, read_series
from drivers.errors import ConfigError
from tests.unit.cell.apps.recordings.pictures import BOARD, CAMERA, POSES, matched, quaternion, row, tuples, understand


def test_a_folder_for_each_pose_is_read(tmp_path, pictures, seen):
    for k, (path, pose) in enumerate(zip(sorted(pictures.iterdir()), POSES, strict=True)):
        folder = tmp_path / f"pose_{k + 1:02d}"
        folder.mkdir()
        (folder / "image.png").symlink_to(path)
        (folder / "data.json").write_text(json.dumps({"stamp": k, "robot": [*pose[:3, 3], *quaternion(pose)]}))
    listing, belonging, _, _ = matched(tmp_path)
    views = [seen[path.name].view for path in sorted(pictures.iterdir())]
    frames = [RecordedFrame(p, listing.name(p), v) for p, v in zip(listing.pictures, views, strict=True)]
    assert attach_poses(frames, belonging, CAMERA, Options()).about["matched_by"] == "folder"
    assert all(np.abs(f.base_from_flange.homogeneous - p).max() < 1e-6 for f, p in zip(frames, POSES, strict=True))


def test_what_is_wrong_is_named_with_its_file(recording, seen):
    tuples(recording)
    (recording / "pose04.txt").write_text("((0.4, nan, 0.5), (0, 0, 0, 1))")
    (recording / "pose05.txt").write_text("")
    (recording / "pose06.txt").write_text("0.1 0.2 0.3")
    (recording / "pose07.txt").unlink()
    (recording / "pose88.txt").write_text(str((tuple(POSES[0][:3, 3]), tuple(quaternion(POSES[0])))))
    (recording / "pictures.zip").write_bytes(b"PK")
    (recording / ".DS_Store").write_bytes(b"\0")
    (recording / "gone.png").symlink_to(recording / "nowhere.png")
    frames, understood, unread = understand(recording, seen)
    assert understood.about["reading"] == "xyz+quaternion-xyzw"
    assert "pose04.txt: it holds values that are not finite" in frames[1].text
    assert [f.name for f in frames if f.base_from_flange is None] == [f"frame{n:02d}.png" for n in (4, 5, 6, 7)]
    reasons = dict(unread)
    assert "empty" in reasons["pose05.txt"]
    assert "3 numbers" in reasons["pose06.txt"]
    assert "archive" in reasons["pictures.zip"]
    assert "hidden" in reasons[".DS_Store"]
    assert "not there" in reasons["gone.png"]


def test_a_folder_of_several_recordings_is_refused(tmp_path, pictures):
    for session in ("monday", "tuesday"):
        (tmp_path / session).mkdir()
        for path in pictures.iterdir():
            (tmp_path / session / path.name).symlink_to(path)
        tuples(tmp_path / session)
    with pytest.raises(ConfigError, match="monday, tuesday"):
        matched(tmp_path)
    for path in (tmp_path / "monday").iterdir():
        path.rename(tmp_path / path.name)
    listing, (own,), _, _ = matched(tmp_path)
    assert len(own.of) == len(listing.pictures) == len(POSES)
    assert ("tuesday/", "a recording of its own: name it with --from") in listing.unread


def test_times_match_poses_to_pictures(tmp_path, pictures, seen):
    names, rows = {}, []
    for k, (path, pose) in enumerate(zip(sorted(pictures.iterdir()), POSES, strict=True)):
        name = f"{1690000000 + 2 * k}.250.png"
        (tmp_path / name).symlink_to(path)
        names[name] = seen[path.name]
        rows.append(row([1690000000 + 2 * k + 0.2, *pose[:3, 3], *quaternion(pose)]))
        rows.append(row([1690000000 + 2 * k + 1.2, *(pose[:3, 3] + 0.1), *quaternion(pose)]))
    for unknown in ("", "time,x,y,z,qx,qy,qz,qw\nn/a," + row([0.1] * 7, ",") + "\n"):
        text = "\n".join(r.replace(" ", "," if unknown else " ") for r in rows)
        (tmp_path / "trajectory.txt").write_text((unknown or "# timestamp tx ty tz qx qy qz qw\n") + text)
        frames, understood, _ = understand(tmp_path, names)
        assert understood.about["matched_by"] == "time"
        for frame, pose in zip(frames, POSES, strict=True):
            assert np.abs(frame.base_from_flange.homogeneous - pose).max() < 1e-6


def test_names_with_a_sign_are_matched_as_they_are_and_the_same_row_twice_is_one(tmp_path, pictures, seen):
    chosen = list(zip(sorted(pictures.iterdir()), POSES, ("-20", "-10", "10", "20"), strict=False))
    (tmp_path / "tilts").mkdir()
    names = {}
    for path, _, tilt in chosen:
        (tmp_path / f"tilts/tilt_{tilt}.png").symlink_to(path)
        names[f"tilt_{tilt}.png"] = seen[path.name]
    lines = [f"tilt_{tilt}.png " + row([*pose[:3, 3], *quaternion(pose)]) for _, pose, tilt in reversed(chosen)]
    (tmp_path / "poses.txt").write_text("\n".join([*lines, lines[1]]))
    frames, understood, _ = understand(tmp_path, names)
    assert understood.about["matched_by"] == "name"
    expected = {f"tilts/tilt_{tilt}.png": pose for _, pose, tilt in chosen}
    for frame in frames:
        assert np.abs(frame.base_from_flange.homogeneous - expected[frame.name]).max() < 1e-6


def test_poses_that_name_no_picture_belong_to_those_that_are_left(tmp_path, pictures):
    """Cropped copies lie beside the pictures: they take no pose."""
    (tmp_path / "poses.txt").write_text("\n".join(row([*p[:3, 3], *quaternion(p)]) for p in POSES[:5]))
    for k, path in enumerate(sorted(pictures.iterdir())[:5]):
        (tmp_path / f"{k}.png").symlink_to(path)
        cv2.imwrite(str(tmp_path / f"Calibrated{k}.png"), cv2.imread(str(path), 0)[6:-6, 8:-8])
    listing = list_folder(tmp_path)
    (poses,), _, _ = read_series(listing)
    assert matched(tmp_path)[1] == []
    frames, _ = read_frames(listing, BOARD, laser=None)
    assert in_order_of_views(poses, frames)
    assert attach_poses(frames, [poses], CAMERA, Options()).about["turn_deg"] < 0.1

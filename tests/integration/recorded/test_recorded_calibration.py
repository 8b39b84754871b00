"""Promises on photographs and poses that others recorded on real hardware, whole and spoilt."""

import shutil

import cv2
import numpy as np
import pytest

from cell.apps.recordings.command import calibrate_folder
from cell.measure.vision.board.view import parse_board
from tests.support.recorded_scenes import recording

CHESS = parse_board("chessboard:7x6:10mm")
RECORDED_FRAMES = range(2, 9)

pytestmark = pytest.mark.recorded


@pytest.fixture(scope="module")
def line_laser(tmp_path_factory):
    """The robot's recording with spoilt frames among its own: what is told of it is told in spite of them."""
    folder = tmp_path_factory.mktemp("robot")
    source = recording("robot_line_laser")
    for path in source.iterdir():
        shutil.copyfile(path, folder / path.name)

    def spoil(number: int, of: int, picture: np.ndarray | None = None, data: bytes | None = None) -> None:
        shutil.copyfile(source / f"pose{of:04d}.txt", folder / f"pose{number:04d}.txt")
        target = folder / f"frame{number:04d}.png"
        if data is None:
            cv2.imwrite(str(target), picture)
        else:
            target.write_bytes(data)

    def frame(number: int) -> np.ndarray:
        return cv2.imread(str(source / f"frame{number:04d}.png"), cv2.IMREAD_GRAYSCALE)

    spoil(20, 2, frame(2) // 30)
    spoil(21, 2, np.full((1024, 1280), 255, np.uint8))
    spoil(22, 3, data=(source / "frame0003.png").read_bytes()[:700_000])
    spoil(23, 4, cv2.resize(frame(4), None, fx=0.5, fy=0.5))
    spoil(24, 4, np.full((1024, 1280), 60, np.uint8))
    spoil(25, 5, cv2.rotate(frame(5), cv2.ROTATE_180))
    spoil(26, 6, np.ascontiguousarray(frame(6)[:, ::-1]))
    spoil(27, 7, data=b"")
    spoil(28, 8, frame(8))
    (folder / "pose0028.txt").write_text("((1.3, 0.1, 1.4), (0.0, 0.0, 0.0, 9.0))")
    spoil(29, 8, frame(8))
    (folder / "pose0029.txt").write_text((source / "pose0008.txt").read_text().replace("((1.3101837", "((1.3601837"))
    return calibrate_folder(folder, CHESS).as_dict()


def test_the_whole_chain_is_flatter_than_the_staged_pipeline(line_laser):
    flatness = line_laser["flatness"]
    assert flatness["rms_mm"] < 0.448 and flatness["p95_mm"] < 1.011
    # On at least as many points and as large a part of the board as the simple pipeline took.
    assert flatness["points"] >= 2763 and min(flatness["extent_mm"]) > 0.95 * 85
    assert max(flatness["extent_mm"]) > 0.95 * 147


def test_frames_that_were_left_out_are_as_flat(line_laser):
    left_out = line_laser["flatness"]["leave_one_out"]
    assert left_out["rms_mm"] < 0.448
    assert [frame["name"] for frame in left_out["per_frame"]] == [f"frame{k:04d}.png" for k in RECORDED_FRAMES]


def test_camera_hand_eye_and_plane_are_those_of_the_simple_pipeline(line_laser):
    used = [frame["name"] for frame in line_laser["frames"] if frame["used"]]
    assert used == [f"frame{k:04d}.png" for k in RECORDED_FRAMES]
    assert line_laser["intrinsics_from_pictures"]["rms_px"] < 0.36
    assert line_laser["intrinsics"]["fx"] == pytest.approx(2366, rel=0.01)
    assert line_laser["intrinsics"]["fy"] == pytest.approx(2372, rel=0.01)
    hand_eye = line_laser["hand_eye"]
    assert hand_eye["setup"] == "eye_in_hand"
    assert np.linalg.norm(np.subtract(hand_eye["translation_mm"], (102.2, 212.9, 353.0))) < 5
    assert hand_eye["closed_form"]["scatter_mm"] < 0.633
    assert line_laser["light_plane"]["rms_mm"] < 0.481


def test_without_poses_the_camera_and_the_light_plane_are_had(tmp_path):
    for path in sorted(recording("robot_line_laser").glob("*.png"))[:5]:
        shutil.copy(path, tmp_path)
    found = calibrate_folder(tmp_path, CHESS).as_dict()
    assert found["intrinsics"]["rms_px"] < 0.36 and found["light_plane"]["rms_mm"] < 0.6
    assert found["hand_eye"] is None and found["flatness"] is None
    assert any("pose" in note for note in found["notes"])


def test_spoilt_frames_are_refused_one_by_one_with_the_reason(line_laser):
    refused = [f for f in line_laser["frames"] if not f["used"]]
    assert {f["name"]: f["reason"] for f in refused} == {
        "frame0020.png": "black", "frame0021.png": "saturated", "frame0022.png": "cut", "frame0023.png": "wrong_size",
        "frame0024.png": "no_board", "frame0025.png": "turned", "frame0026.png": "turned",
        "frame0027.png": "unreadable", "frame0028.png": "no_pose", "frame0029.png": "no_pose",
    }  # fmt: skip
    assert all(len(f["text"]) > 20 for f in refused)

"""Promise: more pictures of the same stop do not make a calibration look better known than the stops allow."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cell.apps.cli.calibration.calibrate import verdicts
from cell.apps.recordings.command import Options, calibrate_folder
from cell.apps.recordings.frames import RecordedFrame
from cell.apps.recordings.pairs import calibrate_pairs, read_pose_pairs
from cell.apps.recordings.series import list_folder
from drivers.errors import ConfigError
from tests.support.recorded_scenes import BOARD, DOTS_PX, FLANGE_FROM_CAMERA, given_pairs, right, scene, solved


def repeated(frames: list[RecordedFrame], times: int) -> list[RecordedFrame]:
    """Each frame so many times, every picture with noise of its own, at the pose that the arm told once."""
    rng = np.random.default_rng(1)
    made = []
    for frame in frames:
        for k in range(times):
            view = replace(frame.view, pixels=frame.view.pixels + rng.normal(0, DOTS_PX, frame.view.pixels.shape))
            name = f"{frame.path.stem}_{k}.png"
            made.append(RecordedFrame(Path(name), name, view, frame.profile, frame.base_from_flange))
    return made


@pytest.mark.parametrize("seed", [1, 2])
def test_pictures_of_one_stop_count_as_one(seed):
    frames = repeated(scene(seed, count=4, arm_mm=1.0, arm_mrad=2.0, laser=False), 4)
    result = solved(frames)
    assert right(result)
    assert any(note.startswith("16 pictures of 4 stops") for note in result["notes"])
    assert sum(frame.rms_px is not None for frame in frames) == 16


def test_the_light_plane_counts_stops_too():
    once = solved(scene(count=6))
    often = solved(repeated(scene(count=6), 3))
    assert right(often)
    assert often["light_plane"]["sigma_place_mm"] == pytest.approx(once["light_plane"]["sigma_place_mm"], rel=0.5)


def test_many_pictures_of_three_stops_are_not_enough():
    result = solved(repeated(scene(count=3), 5))
    assert "3 stops have a flange pose; a hand-eye that can be checked needs 4" in result["refused"]["hand_eye"]
    assert right(result)


def test_pairs_of_one_stop_count_as_one():
    pairs = given_pairs(scene(count=6, laser=False))
    once, often = (calibrate_pairs([p for p in pairs for _ in range(times)]).as_dict() for times in (1, 4))
    assert any(note.startswith("24 pairs of 6 stops") for note in often["notes"])
    np.testing.assert_allclose(often["hand_eye"]["sigma_mm"], once["hand_eye"]["sigma_mm"], rtol=1e-3)
    with pytest.raises(ConfigError, match="of 3 stops"):
        calibrate_pairs([pair for pair in pairs[:3] for _ in range(4)])


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_scale_that_stands_alone_is_a_doubt_beside_the_value(seed):
    """28 views round a board: what moves the boards a little looks like a scale, and the hand-eye is right."""
    pairs = given_pairs(scene(seed, count=28, arm_mm=0.6, arm_mrad=0.3, laser=False, spread=0.15))
    at = np.array([b.act(BOARD.points().mean(axis=0)) for _, b in pairs])
    off = (at - at.mean(axis=0)) * (1 / 1.15 - 1)
    pairs = [(f, pin.SE3(b.rotation, b.translation + d)) for (f, b), d in zip(pairs, off, strict=True)]
    result = calibrate_pairs(pairs).as_dict()
    (check,) = (c for c in result["checks"] if "travel" in c["name"])
    assert check["verdict"] == "doubt", check
    off = np.array(result["hand_eye"]["translation_mm"]) - 1e3 * FLANGE_FROM_CAMERA.translation
    sigma = np.linalg.norm(result["hand_eye"]["sigma_mm"])
    assert np.linalg.norm(off) / 3 < sigma < 1.0


@pytest.mark.parametrize(
    ("flange", "board", "words"),
    [
        (1e3, 1e3, "flange's .* Divide"),
        (1e3, 1.0, "flange's .* Divide"),
        (1.0, 1e3, "board's .* Divide"),
        (0, 1, "be 0"),
    ],
)
def test_pairs_that_are_not_in_metres_are_refused(flange, board, words):
    pairs = [
        (pin.SE3(f.rotation, flange * f.translation), pin.SE3(b.rotation, board * b.translation))
        for f, b in given_pairs(scene(laser=False))
    ]
    with pytest.raises(ConfigError, match=words):
        calibrate_pairs(pairs)


def matrices() -> np.ndarray:
    return np.array([(f.homogeneous, b.homogeneous) for f, b in given_pairs(scene(laser=False))])


def stored(folder: Path, pairs: np.ndarray, name: str = "pairs.json", encoding: str = "utf-8") -> None:
    (folder / name).write_bytes(json.dumps(pairs.tolist()).encode(encoding))


@pytest.mark.parametrize(("name", "encoding"), [("p.JSON", "utf-8"), ("p.json", "utf-8-sig"), ("p.json", "utf-16")])
def test_a_list_of_pairs_is_read_as_other_programs_write_it(tmp_path, name, encoding):
    stored(tmp_path, matrices(), name, encoding)
    assert len(read_pose_pairs(list_folder(tmp_path))) == len(matrices())


def test_what_is_no_list_of_pairs_is_told_with_file_pair_and_next_step(tmp_path):
    pairs = matrices()
    pairs[3, 1, 0, 3] = np.nan
    stored(tmp_path, pairs)
    with pytest.raises(ConfigError, match="pair 3 holds"):
        read_pose_pairs(list_folder(tmp_path))
    stored(tmp_path, np.swapaxes(matrices(), 2, 3))
    with pytest.raises(ConfigError, match=r"pairs\.json: pair 0: .* are to be transposed"):
        read_pose_pairs(list_folder(tmp_path))
    (tmp_path / "pairs.json").write_text(json.dumps(matrices().tolist())[:-100])
    with pytest.raises(ConfigError, match=r"pairs\.json: it is no JSON: .*; give it whole"):
        read_pose_pairs(list_folder(tmp_path))
    for name in ("pairs.json", "more.json"):
        stored(tmp_path, matrices(), name)
    with pytest.raises(ConfigError, match=r"pairs of poses are in more\.json, pairs\.json"):
        read_pose_pairs(list_folder(tmp_path))


def test_the_set_up_that_a_person_named_is_the_one_and_what_pairs_have_nothing_of_is_refused(tmp_path):
    stored(tmp_path, matrices())
    for setup in (None, "eye_in_hand"):
        assert calibrate_folder(tmp_path, None, Options(setup=setup)).as_dict()["hand_eye"]["setup"] == "eye_in_hand"
    with pytest.raises(
        ConfigError, match=r"--setup eye-to-hand: the pairs put the board \d+ mm apart so, and 0\.\d mm"
    ):
        calibrate_folder(tmp_path, None, Options(setup="eye_to_hand"))
    for said in ({"poses": "xyz+rpy-deg"}, {"laser": None}, {"pose_field": "tool"}):
        with pytest.raises(ConfigError, match="holds pairs of poses in m, no pictures; leave it out"):
            calibrate_folder(tmp_path, None, Options(**said))


def test_a_camera_in_the_flange_is_a_doubt():
    """The second of each pair upside down gives what the flange is to the board: here they are one."""
    flanges = [flange for flange, _ in given_pairs(scene(laser=False))]
    stands = pin.SE3(pin.exp3(np.array([0.3, -0.2, 0.4])), np.array([0.6, 0.1, 0.2]))
    result = calibrate_pairs([(flange, flange.inverse() * stands) for flange in flanges]).as_dict()
    assert [c["verdict"] for c in result["checks"] if c["name"] == "a camera at the origin"] == ["doubt"]
    assert "Invert it" in verdicts(result)[1]


def test_a_board_that_was_moved_half_way_is_in_the_stated_deviation():
    pairs = sorted(given_pairs(scene(1, count=20, laser=False)), key=lambda pair: pair[0].translation[0])
    moved = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.03]))
    for k in range(10, 20):
        base_from_camera = pairs[k][0] * FLANGE_FROM_CAMERA
        pairs[k] = pairs[k][0], base_from_camera.actInv(moved * base_from_camera * pairs[k][1])
    found = calibrate_pairs(pairs).as_dict()["hand_eye"]
    off = np.array(found["translation_mm"]) - 1e3 * FLANGE_FROM_CAMERA.translation
    assert np.linalg.norm(off) < 2.0 * np.linalg.norm(found["sigma_mm"])

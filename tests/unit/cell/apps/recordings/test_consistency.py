"""Promises on frames that disagree with the others: they are named, and views that do not turn have no vote."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cell.apps.recordings.agreement import decide
from cell.apps.recordings.consistency import odd_turns
from cell.apps.recordings.pairs import calibrate_pairs
from cell.apps.recordings.series import Series
from cell.apps.recordings.solution import agreeing
from cell.apps.recordings.texts import PoseRecord
from tests.support.recorded_scenes import FLANGE_FROM_CAMERA, TRUTH, given_pairs, right, scene, solved
from tests.unit.cell.apps.recordings.pictures import CAMERA, POSES, row, understand


@pytest.mark.parametrize(("a", "b"), [(0, 3), (2, 6)])
def test_two_exchanged_poses_of_seven_do_not_hide_the_reading(recording, seen, a, b):
    """The frames that are left give the reading; the two are named by what compares the turns."""
    for k in range(7, len(POSES)):
        (recording / f"frame{k + 3:02d}.png").unlink()
    for k in range(7):
        pose = POSES[{a: b, b: a}.get(k, k)]
        (recording / f"pose{k + 3:02d}.txt").write_text(row(pose.ravel()))
    frames, understood, _ = understand(recording, seen)
    assert not understood.refused, understood.refused
    kept = agreeing(frames, CAMERA)
    assert len(kept) == 5
    assert {f.name for f in frames if f not in kept} == {f"frame{k + 3:02d}.png" for k in (a, b)}


@pytest.mark.parametrize("seed", [3, 11, 13])
def test_views_that_do_not_turn_carry_no_vote(seed):
    """Of 15 views 11 have one orientation, and agree with every rotation; wrong ones among the others are named."""
    pairs = given_pairs(scene(seed, count=15, arm_mm=0.5, arm_mrad=2.0, laser=False))
    still = [k for k in range(15) if k not in (2, 5, 8, 12)]
    flange, board = pairs[0]
    base_from_board = flange * FLANGE_FROM_CAMERA * board
    rng = np.random.default_rng(seed)
    for k in still:
        moved = pin.SE3(flange.rotation @ pin.exp3(rng.normal(0, 2e-3, 3)), flange.translation + rng.normal(0, 0.04, 3))
        seen = (moved * FLANGE_FROM_CAMERA).inverse() * base_from_board
        pairs[k] = (moved, pin.SE3(seen.rotation @ pin.exp3(rng.normal(0, 2e-3, 3)), seen.translation))
    result = calibrate_pairs(pairs).as_dict()
    assert all(f["used"] for f in result["frames"])
    off = np.linalg.norm(np.array(result["hand_eye"]["translation_mm"]) - 1e3 * FLANGE_FROM_CAMERA.translation)
    assert off < 3 * np.linalg.norm(result["hand_eye"]["sigma_mm"])
    one = Series("poses", [PoseRecord(Path("poses"), "row", "", f.homogeneous.ravel()) for f, _ in pairs])
    one.of = dict(enumerate(one.records))
    decision = decide([one], {k: [b] for k, (_, b) in enumerate(pairs)}, 0.018)
    assert decision.best.reading.name == "matrix-4x4"
    flanges = [f for f, _ in pairs]
    turn = pin.log3(flanges[0].rotation.T @ flanges[5].rotation)
    flanges[5] = pin.SE3(flanges[5].rotation @ pin.exp3(0.3 * turn / np.linalg.norm(turn)), flanges[5].translation)
    assert list(odd_turns(flanges, [b for _, b in pairs])) == [5]


def test_two_exchanged_poses_are_named_and_the_rest_is_right():
    frames = scene(seed=2)
    a, b = frames[2], frames[5]
    a.base_from_flange, b.base_from_flange = b.base_from_flange, a.base_from_flange
    result = solved(frames)
    assert [f.name for f in frames if f.reason is not None] == [a.name, b.name]
    assert right(result) and result["hand_eye"] is not None


def test_a_board_of_odd_counts_that_flips_is_turned_back():
    frames = scene(seed=3, laser=False, board="chessboard:9x7:15mm")
    for frame in frames[1:6:2]:
        frame.view = replace(frame.view, ids=62 - frame.view.ids)
    result = solved(frames)
    assert right(result) and result["hand_eye"] is not None
    assert all(frame.reason is None for frame in frames)


def test_good_frames_of_a_small_set_are_not_blamed():
    for seed in range(5):
        frames = scene(seed, count=4, arm_mm=1.0, arm_mrad=2.0, laser=False)
        assert agreeing(frames, TRUTH) == frames

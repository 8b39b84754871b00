"""Promise: more pictures of the same stop do not make a calibration look better known than the stops allow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.calibration.recorded.folder import RecordedFrame
from tests.recorded_scenes import DOTS_PX, scene
from tests.test_no_confident_wrong_answer import right, solved


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
    result = solved(repeated(scene(seed, count=4, arm_mm=1.0, arm_mrad=2.0, laser=False), 4))
    assert right(result)
    assert any(note.startswith("16 pictures of 4 stops") for note in result["notes"])
    assert len(result["frames_rms"]) == 16


def test_the_light_plane_counts_stops_too():
    once = solved(scene(count=6))
    often = solved(repeated(scene(count=6), 3))
    assert right(often)
    assert often["light_plane"]["sigma_place_mm"] == pytest.approx(once["light_plane"]["sigma_place_mm"], rel=0.5)


def test_many_pictures_of_three_stops_are_not_enough():
    result = solved(repeated(scene(count=3), 5))
    assert "3 stops" in result["refused"]["hand_eye"]
    assert right(result)

"""A figure is held against its limits, and says what is the matter."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from cell.measure.calibration.judge.checks import QualityCheck, camera_checks, refused_parts
from cell.measure.calibration.solve.intrinsics import choose_lens
from tests.support.recorded_scenes import scene


@pytest.mark.parametrize(("tilt", "verdict"), [(0.08, "doubt"), (0.45, "ok")])
def test_a_board_that_was_hardly_tilted_is_a_doubt_with_its_angle(tilt, verdict):
    """A bend that nobody sees and the focal length look alike: 8 pictures of a real board were 5 deviations off."""
    frames = scene(seed=6, count=8, laser=False, tilt=tilt)
    views = [frame.view for frame in frames]
    found, _ = choose_lens(views)
    (check,) = (c for c in camera_checks(found, views, [f.name for f in frames]) if "tilt" in c.name)
    assert check.verdict == verdict
    if verdict == "doubt":
        assert re.search(r"tilted by 1?\d° at most.*tilt it by 45°", check.text)


@pytest.mark.parametrize(
    ("value", "verdict", "words"),
    [
        (0.99, "ok", ""),
        (1.0, "doubt", "light-plane: its tilt is 1 deg, usual below 1 deg: look again"),
        (2.0, "refused", "light-plane: its tilt is 2 deg, allowed below 2 deg: look again"),
        (np.inf, "refused", "is inf deg"),
        (np.nan, "refused", "is nan deg"),
    ],
)
def test_a_figure_is_held_against_its_limits_and_one_that_is_no_number_is_refused(value, verdict, words):
    check = QualityCheck("light_plane", "its tilt", value, doubt=1.0, refuse=2.0, unit="deg", says="look again")
    assert check.verdict == verdict
    assert words in check.text and bool(check.text) == bool(words)
    assert refused_parts([check]) == ({"light_plane": [check]} if verdict == "refused" else {})
    json.dumps(replace(check, refuse=np.inf).as_dict(), allow_nan=bool(np.isnan(value)))

"""Promises on conventions: each of the table is found by the pictures, any other is read by its name."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cell.apps.recordings.conventions import TRIED, check_reading
from drivers.errors import ConfigError
from tests.unit.cell.apps.recordings.pictures import POSES, row, understand

# By scipy, beside the table of the product.
TURNS = {
    "quaternion-wxyz": lambda r: r.as_quat()[[3, 0, 1, 2]],
    "rpy-rad": lambda r: r.as_euler("xyz"),
    "zyz-deg": lambda r: r.as_euler("ZYZ", degrees=True),
    "zyx-deg": lambda r: r.as_euler("zyx", degrees=True),
    "rotvec-deg": lambda r: np.degrees(r.as_rotvec()),
    "XYZ-rad": lambda r: r.as_euler("XYZ"),
}


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("kind", TURNS)
def test_a_convention_of_the_table_is_found_and_another_is_read_when_it_is_named(recording, seen, kind, first):
    turns = [TURNS[kind](Rotation.from_matrix(p[:3, :3])) for p in POSES]
    rows = [row(np.r_[t, p[:3, 3]] if first else np.r_[p[:3, 3], t]) for p, t in zip(POSES, turns, strict=True)]
    (recording / "poses.txt").write_text("\n".join(rows))
    name = f"{kind}+xyz" if first else f"xyz+{kind}"
    check_reading(name)
    _, alone, _ = understand(recording, seen)
    frames, asked, _ = understand(recording, seen, poses=name)
    assert all(np.abs(f.base_from_flange.homogeneous - p).max() < 1e-6 for f, p in zip(frames, POSES, strict=True))
    assert asked.about["reading"] == name
    assert alone.about.get("reading") == name if name in TRIED else "--poses" in alone.refused


@pytest.mark.parametrize("name", ["xyz+abc", "rotvec-rad", "xyz+XXZ-deg", "xyz+rpy-deg+xyz", "matrix-3x4"])
def test_a_name_of_no_convention_is_refused_with_the_form(name):
    with pytest.raises(ConfigError, match=r"allowed is xyz\+KIND"):
        check_reading(name)

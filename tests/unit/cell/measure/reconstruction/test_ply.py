"""Promises of `cell.measure.reconstruction.ply`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.measure.reconstruction import deviation_colours, write_ply


def test_a_ply_with_columns_of_different_length_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="quality has 3 values for 2 points"):
        write_ply(tmp_path / "x.ply", np.zeros((2, 3)), quality=np.zeros(3))


def test_deviation_colours_run_from_blue_over_green_to_red() -> None:
    colours = deviation_colours([-1.0, -0.001, 0.0, 0.001, np.nan], 0.001)
    assert colours.tolist() == [[0, 0, 255], [0, 0, 255], [0, 255, 0], [255, 0, 0], [128, 128, 128]]
    with pytest.raises(ValueError, match="greater than 0"):
        deviation_colours([0.0], 0.0)

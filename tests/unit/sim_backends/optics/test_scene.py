"""Promises of `sim_backends.optics.scene`."""

from __future__ import annotations

import numpy as np
import pytest

from sim_backends.optics import Board
from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.laser.stripe import crossings
from sim_backends.optics.scene import LaserOptics, PlaneInstance


@pytest.mark.parametrize("spec", ["marked_dots:9x7", "stars:9x7:20mm", "dots:1x7:20mm", "dots:9x7:20", "dots:9x7:0mm"])
def test_wrong_board_names_are_refused(spec):
    with pytest.raises(ValueError, match="board"):
        Board.parse(spec)


OPTICS = CameraOptics(640, 480, 1667.0, 1667.0, 319.5, 239.5)


def test_a_bowed_sheet_is_seen_where_geometry_says() -> None:
    wall = np.eye(4)
    wall[2, 3] = 0.130
    bow = 1e-4 * 0.13 / 0.018**2
    flat = crossings(OPTICS, LaserOptics(), PlaneInstance(wall, (0.2, 0.2)))
    bent = crossings(OPTICS, LaserOptics(bow=bow), PlaneInstance(wall, (0.2, 0.2)))
    # Across the optical axis, a sheet that is off by s along its normal meets the wall s / n_x to the side.
    laser = LaserOptics()
    along = np.hypot(0.130, 0.130 / 3.5)
    sag = bow * flat.points[:, 1] ** 2 / along
    assert bent.columns - flat.columns == pytest.approx(1667.0 / 0.130 * sag / laser.normal[0], abs=2e-3)
    assert sag.max() > 0.9e-4

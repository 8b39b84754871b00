"""Promises of a whole picture: what may be out of view, and what a seed fixes."""

import numpy as np
import pytest

from sim_backends.optics import BoardInstance, CameraOptics
from tests.support.simulator.optics_scene import FINE, FOCAL_PX, LENS, SCAN, expose, pose


@pytest.mark.parametrize(
    "translation",
    [[-0.015, -0.012, -0.130], [2.0, 0.0, 0.130], [0.0, 0.0, 0.0]],
    ids=["behind", "beside", "edge on in the lens"],
)
def test_boards_that_cannot_be_seen_are_left_out(translation):
    image = expose(SCAN, [BoardInstance(pose([0, 0, 0], translation), FINE)], 0.020)
    np.testing.assert_allclose(image, 0.35 * 25_000 * 0.4 * 0.020, rtol=1e-5)


def test_a_board_partly_out_of_view_shows_the_part_that_is_in_view():
    wide = CameraOptics(1280, 480, FOCAL_PX, FOCAL_PX, 639.5, 239.5, LENS, transmission=0.4, vignetting=0.0)
    shifted = pose([0.3, 0.1, 0.1], [0.005, -0.012, 0.130])
    narrow_view = expose(SCAN, [BoardInstance(shifted, FINE)], 0.020)
    wide_view = expose(wide, [BoardInstance(shifted, FINE)], 0.020)
    np.testing.assert_allclose(narrow_view[:, :-10], wide_view[:, 320:950], atol=0.02)
    assert 0.05 < (narrow_view > 100).mean() < 0.5

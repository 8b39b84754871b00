"""Promises of the board detection under light, blur, hidden parts and wrong boards, on pictures drawn by ray casting.

A small part of `cell bench board`: the renderer shares no code with the detection, and OpenCV's lens is the truth.
"""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.measure.geometry.poses import difference
from cell.measure.vision.board.board import board_pose, find_board
from cell.measure.vision.board.view import KINDS, BoardView
from lab.bench.board.campaign import Tally as BoardTally
from lab.bench.board.campaign import camera_of, judge
from lab.bench.board.conditions import CONDITIONS, LENSES, draw_pose, draw_spec, draw_view
from lab.bench.board.render import Placed, true_pixels

BY_NAME = {condition.name: condition for condition in CONDITIONS}
DOTS = ("marked_dots", "asymmetric_dots", "dots")


def seen(name, kind, seed=0):
    return draw_view(BY_NAME[name], kind, np.random.default_rng(seed))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["defocus sigma 3 px", "cluttered background"])
def test_a_board_is_found_with_every_point_under_its_own_name(name, kind):
    tally = BoardTally()
    judge(seen(name, kind), "found", tally)
    assert (tally.found, tally.wrong) == (1, 0)
    # Blurred by half the cells that are printed inside them, tags are found, and known to no more than they say.
    assert tally.row()["centre_rms_px"] < (0.6 if (name, kind) == ("defocus sigma 3 px", "aprilgrid") else 0.15)


def test_blurred_tags_say_that_their_corners_are_poorly_known():
    view = seen("defocus sigma 3 px", "aprilgrid")
    found = find_board(view.picture, view.spec)
    off = found.pixels - view.pixels[found.ids]
    assert np.sqrt(np.mean((off / found.sigma[:, None]) ** 2)) < 2.0


@pytest.mark.parametrize("kind", ["chessboard", "charuco"])
def test_corners_are_had_to_a_fiftieth_of_a_pixel(kind):
    view = seen("tilt 35-50 deg", kind)
    found = find_board(view.picture, view.spec)
    named = min(found.turns(), key=lambda t: float(np.abs(t.pixels - view.pixels[t.ids]).max()))
    assert np.sqrt(np.mean((named.pixels - view.pixels[named.ids]) ** 2)) < 0.02


@pytest.mark.parametrize("kind", DOTS)
@pytest.mark.parametrize("tilt", [0, 25, 50])
def test_dots_seen_through_a_lens_leave_no_bias_in_the_pose(kind, tilt):
    rng = np.random.default_rng(tilt)
    spec, lens = draw_spec(kind, rng), LENSES[2]
    placed = Placed(spec, draw_pose(spec, lens, np.radians(tilt), rng, 0.8))
    ids = np.arange(len(spec.lattice()))
    pixels = true_pixels(lens, placed)
    view = BoardView(spec, (lens.width, lens.height), ids, pixels, np.full(len(ids), 0.02), False, placed.radius)
    found = board_pose(view, camera_of(lens))
    error = difference(found.camera_from_board, pin.SE3(placed.pose))
    assert found.rms_px < 1e-3
    assert np.abs(error[:3]).max() < 1e-5 and np.abs(error[3:]).max() < 3e-5
    # Corners where the dots are: without the conic's projection the same pixels give a worse fit.
    assert board_pose(replace(view, dot_radius=0.0), camera_of(lens)).rms_px > 10 * found.rms_px

"""Which dot of a board is which: by its rings also in part, and of a symmetric board by an assumption."""

import itertools

import numpy as np
import pytest

from cell.measure.vision.board.board import find_board
from cell.measure.vision.board.lattice import identify
from cell.measure.vision.board.view import parse_board
from cell.measure.vision.pictures import PictureRefused, Reason
from tests.unit.cell.measure.vision.board.drawn_boards import FINE, LARGE, SCAN, TARGET, photograph, placed, true_pixels


def test_a_part_of_a_marked_board_is_enough():
    pose = placed(FINE, 0.130, 15, shift=(0.008, 0.006))
    view = find_board(photograph(SCAN, FINE, pose), parse_board(FINE))
    assert 60 < len(view.ids) < 99
    assert np.abs(view.pixels - true_pixels(SCAN, pose, view)).max() < 0.1


def test_symmetric_dots_say_that_their_order_is_assumed():
    text = "dots:6x6:34mm"
    pose = placed(text, 1.0, 40)
    view = find_board(photograph(TARGET, text, pose), parse_board(text))
    off = [np.abs(view.pixels - true_pixels(TARGET, pose, turn)).max() for turn in view.turns()]
    assert view.order_assumed and len(off) == 4 and min(off) < 0.1


@pytest.mark.parametrize("flipped", [False, True])
def test_a_part_of_a_board_is_mirrored_where_its_picture_is_and_only_there(flipped):
    spec = parse_board("marked_dots:20x14:5mm")
    part = np.array([(x, y) for y in range(4, 9) for x in range(5, 16)])
    for clearest in itertools.permutations((0.9, 0.8, 0.7)):
        scores = np.zeros((len(part), 2))
        for ring, score in zip(spec.rings, clearest, strict=True):
            scores[(part == ring).all(axis=1)] = score
        if flipped:
            with pytest.raises(PictureRefused, match="mirrored"):
                identify(spec, part * [-1, 1], scores)
        else:
            assert (identify(spec, part, scores)[0] == part).all()


def test_a_board_without_its_rings_is_refused():
    picture = photograph(TARGET, LARGE, placed(LARGE, 1.0, 30))
    half = np.where(np.arange(1280) < 640, picture, 90).astype(np.uint8)
    with pytest.raises(PictureRefused) as refused:
        find_board(half, parse_board(LARGE))
    assert refused.value.reason in (Reason.AMBIGUOUS, Reason.NO_BOARD)

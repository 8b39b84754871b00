"""A board that ends elsewhere than the named one, or that could be two, is refused."""

import cv2
import numpy as np
import pytest

from cell.measure.geometry.poses import transform
from cell.measure.vision.board.board import find_board
from cell.measure.vision.board.view import parse_board
from cell.measure.vision.pictures import PictureRefused, Reason
from lab.bench.board.conditions import CONDITIONS, draw_view
from tests.unit.cell.measure.vision.board.drawn_boards import LARGE, TARGET, photograph, placed


@pytest.mark.parametrize("turn", [0.0, 0.35])
def test_dots_with_a_frame_round_them_end_there(turn):
    """Plates as some vision programs sell them: a black line where the next dots would be."""
    sheet = np.full((1000, 1000), 225, np.uint8)
    cv2.rectangle(sheet, (80, 80), (920, 920), 25, 14)
    for i, j in np.ndindex(7, 7):
        cv2.circle(sheet, (200 + 100 * i, 200 + 100 * j), 25, 25, -1, cv2.LINE_AA)
    into = np.array([[0.4 * np.cos(turn), -0.4 * np.sin(turn), 200], [0.4 * np.sin(turn), 0.36, 20], [0, 1e-4, 1.0]])
    image = cv2.warpPerspective(sheet, into, (640, 480), flags=cv2.INTER_AREA, borderValue=60)
    view = find_board(cv2.GaussianBlur(image, (0, 0), 0.8), parse_board("dots:7x7:25mm"))
    assert len(view.ids) == 49
    with pytest.raises(PictureRefused, match="7×7"):
        find_board(image, parse_board("dots:7x6:25mm"))


@pytest.mark.parametrize("pitches", [0.05, 0.2, 0.35])
def test_a_row_that_the_pictures_rim_cuts_does_not_make_another_board(pitches):
    pose, spec = placed(LARGE, 1.0, 0.0, spin=0.0), parse_board(LARGE)
    first, last = np.unique(TARGET.project(transform(pose, spec.points()))[:, 1].round())[[0, -1]]
    cut = round(first - pitches * (last - first) / 6)
    assert len(find_board(photograph(TARGET, LARGE, pose)[cut:].copy(), spec).ids) == 54


def view_of(name, kind, seed=0):
    condition = next(one for one in CONDITIONS if one.name == name)
    return draw_view(condition, kind, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("mirrored", "charuco"),
        ("a smaller board instead", "marked_dots"),
        ("a larger board instead", "marked_dots"),
        ("a larger board instead", "chessboard"),
        ("a smaller board instead", "asymmetric_dots"),
        ("another kind instead", "charuco"),
        ("nothing but noise", "dots"),
    ],
)
def test_what_is_not_the_named_board_is_refused(name, kind):
    view = view_of(name, kind)
    with pytest.raises(PictureRefused) as refused:
        find_board(view.picture, view.spec)
    assert refused.value.reason in (Reason.NO_BOARD, Reason.AMBIGUOUS, Reason.MIRRORED)
    assert len(str(refused.value)) > 20


@pytest.mark.parametrize("kind", ["marked_dots", "chessboard", "charuco"])
def test_two_boards_that_could_both_be_meant_are_refused(kind):
    view = view_of("two of the same board", kind, 2)
    with pytest.raises(PictureRefused) as refused:
        find_board(view.picture, view.spec)
    assert refused.value.reason is Reason.AMBIGUOUS

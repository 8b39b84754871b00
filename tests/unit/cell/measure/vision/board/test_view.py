"""Promises of the boards' names."""

import pytest

from cell.measure.vision.board.view import parse_board
from drivers.errors import ConfigError
from tests.unit.cell.measure.vision.board.drawn_boards import FINE


@pytest.mark.parametrize("name", [FINE, "chessboard:7x6:10mm", "dots:6x6:34mm", "asymmetric_dots:4x11:15mm"])
def test_board_names_round_trip(name):
    assert parse_board(name).name == name


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("chessboard", "parts"),
        ("chess:7x6:10mm", "unknown kind"),
        ("chessboard:7by6:10mm", "columns x rows"),
        ("chessboard:7x6:10", "unit"),
        ("chessboard:1x6:10mm", "needs"),
        ("chessboard:7x6:0mm", "outside"),
        ("chessboard:7x6:10mm:3mm", "nothing may follow"),
        ("charuco:8x6:15mm:DICT_9X9", "dictionary"),
        ("charuco:8x6:15mm:20mm", "smaller"),
    ],
)
def test_a_wrong_board_name_says_what_is_wrong(name, complaint):
    with pytest.raises(ConfigError, match=complaint):
        parse_board(name)

"""Promises of `sim_backends.optics.scene`."""

import pytest

from sim_backends.optics import Board


@pytest.mark.parametrize("spec", ["marked_dots:9x7", "stars:9x7:20mm", "dots:1x7:20mm", "dots:9x7:20", "dots:9x7:0mm"])
def test_wrong_board_names_are_refused(spec):
    with pytest.raises(ValueError, match="board"):
        Board.parse(spec)

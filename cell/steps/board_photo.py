"""The board photograph: the target camera square in front of the board, several pictures, one pose."""

from __future__ import annotations

from collections.abc import Callable

import pinocchio as pin

from cell.steps.moves import Mover
from cell.steps.photograph import BoardFix


def board_photo(
    base_from_flange: pin.SE3,
    mover: Mover,
    photograph: Callable[[int], BoardFix],
    count: int,
    progress: Callable[[float, str], None],
) -> BoardFix:
    """Move to the planned photograph pose, settle, and take the board's pose from `count` photographs.

    Refusals (not found, too oblique, residual too high, ambiguous) come from `photograph` with their reason.
    """
    progress(0.1, "arm to the photograph pose")
    mover.to(base_from_flange, "the photograph pose")
    progress(0.7, "photographing the board")
    return photograph(count)

"""Images to numbers: stripe centres and board points, each with its own uncertainty or the reason of its refusal.

Names are imported when they are first asked for: a command that only reads a board's name out of a configuration does
not wait for the compiler of the stripe's loops.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.measure.vision.board.board import BoardPose, board_pose, find_board
    from cell.measure.vision.board.view import BoardSpec, BoardView, parse_board
    from cell.measure.vision.pictures import PictureRefused, Reason, check_picture, read_picture
    from cell.measure.vision.stripe.extract import StripeStream, extract
    from cell.measure.vision.stripe.planes import LaserChannel, read_colours
    from cell.measure.vision.stripe.profile import Mark, StripeProfile, StripeSettings

__all__ = [
    "BoardPose", "BoardSpec", "BoardView", "LaserChannel", "Mark", "PictureRefused", "Reason", "StripeProfile",
    "StripeSettings", "StripeStream", "board_pose", "check_picture", "extract", "find_board", "parse_board",
    "read_colours", "read_picture",
]  # fmt: skip

_ROOMS = {
    "board.board": "BoardPose board_pose find_board",
    "board.view": "BoardSpec BoardView parse_board",
    "pictures": "PictureRefused Reason check_picture read_picture",
    "stripe.extract": "StripeStream extract",
    "stripe.planes": "LaserChannel read_colours",
    "stripe.profile": "Mark StripeProfile StripeSettings",
}


def __getattr__(name: str) -> object:
    for room, names in _ROOMS.items():
        if name in names.split():
            return getattr(import_module(f"{__name__}.{room}"), name)
    raise AttributeError(f"module '{__name__}' has no attribute {name!r}")

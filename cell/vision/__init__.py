"""Images to numbers: stripe centres and board points, each with its own uncertainty or the reason of its refusal."""

from cell.vision.board.board import BoardPose, board_pose, find_board
from cell.vision.board.spec import BoardSpec, parse_board
from cell.vision.board.view import BoardView
from cell.vision.pictures import PictureRefused, Reason, check_picture, read_picture
from cell.vision.stripe.extract import Laser, Mark, StripeProfile, StripeSettings, extract
from cell.vision.stripe.planes import read_colours
from cell.vision.stripe.read import read_stripe
from cell.vision.stripe.stream import StripeStream

__all__ = [
    "BoardPose",
    "BoardSpec",
    "BoardView",
    "Laser",
    "Mark",
    "PictureRefused",
    "Reason",
    "StripeProfile",
    "StripeSettings",
    "StripeStream",
    "board_pose",
    "check_picture",
    "extract",
    "find_board",
    "parse_board",
    "read_colours",
    "read_picture",
    "read_stripe",
]

"""Recorded frames: pictures with the board and the stripe in each, the flange pose, and why one is not used.

The stripe may be in the picture of the board or in a second one, taken at the same place with the laser on.
How it is read is the business of `stripes.py`.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.calibration.recorded.drawn import set_copies_aside, small_copy
from cell.calibration.recorded.listing import PICTURES, Listing
from cell.calibration.recorded.matching import frame_key
from cell.calibration.recorded.places import Place, find_places, named_lit
from cell.calibration.recorded.stripes import Channel, ReadStripe, Source, choose_channel, read_on_board
from cell.geometry.camera import Array
from cell.geometry.poses import from_matrix
from cell.vision.board.board import find_board
from cell.vision.board.spec import BoardSpec
from cell.vision.board.view import BoardView
from cell.vision.pictures import PictureRefused, Reason, read_picture
from cell.vision.stripe.extract import Laser, StripeProfile
from drivers.errors import ConfigError


@dataclass(eq=False)
class RecordedFrame:
    """One picture of a folder: what is seen in it, its pose, or `reason` and `text` why it is not used.

    `name` is below the folder; `pose_from` the file of the pose, `stripe_from` that of a second picture with the laser,
    `stripe_off` that of the picture without it that was taken off. `stripe_text` says why a line is not believed;
    `stripe_left_out` how many points on the board are marked, by the mark. `shows`: the frame of the same place that is
    used in its stead.
    """

    path: Path
    name: str = ""
    view: BoardView | None = None
    profile: StripeProfile | None = None
    base_from_flange: pin.SE3 | None = None
    reason: Reason | None = None
    text: str = ""
    pose_from: str = ""
    stripe_from: str = ""
    stripe_off: str = ""
    stripe_text: str = ""
    stripe_left_out: dict[str, int] = field(default_factory=dict)
    shows: RecordedFrame | None = None

    def refuse(self, reason: Reason, text: str) -> None:
        """Set the frame aside."""
        self.reason, self.text = reason, text


def read_frames(
    listing: Listing, spec: BoardSpec, links: Sequence[dict[str, str]] = (), laser: Laser | None = Laser.AUTO
) -> tuple[list[RecordedFrame], Channel]:
    """Every picture of a listing, with board and stripe, or refused with a reason; and where the laser was read.

    `links` are pictures that a table names together; `laser` None looks for no stripe. Raises ConfigError where there
    are no pictures.
    are no pictures.
    """
    if not listing.pictures:
        raise ConfigError(f"{listing.folder} holds no pictures ({', '.join(PICTURES)})")
    frames = [RecordedFrame(path, listing.name(path)) for path in listing.pictures]
    seen: dict[str, RecordedFrame] = {}
    small: list[NDArray[np.float32] | None] = []
    for frame in frames:
        small.append(None)
        try:
            image = read_picture(frame.path)
            small[-1] = small_copy(image)
            frame.view = find_board(image, spec)
        except PictureRefused as refused:
            frame.refuse(refused.reason, str(refused))
        except (ArithmeticError, LookupError, ValueError, cv2.error) as error:
            # One picture that upsets the search must not end the reading of the others.
            frame.refuse(Reason.UNREADABLE, f"the search for the board failed: {type(error).__name__}: {error}")
        if frame.reason not in (Reason.UNREADABLE, Reason.CUT):
            # Of pictures without a board, all dark for example, those of other frames may well be the same.
            digest = "" if frame.view is not None else frame_key(frame.name)
            digest += hashlib.sha1(frame.path.read_bytes(), usedforsecurity=False).hexdigest()
            first = seen.setdefault(digest, frame)
            if first is not frame:
                frame.shows = first
                frame.refuse(Reason.DUPLICATE, f"the same file as {first.name}")
    set_copies_aside(frames, small)
    _refuse_other_sizes(frames)
    channel = _read_stripes(frames, find_places(frames, links), laser)
    for frame in frames:
        # The same file as a copy shows what that copies.
        while frame.shows is not None and frame.shows.shows is not None:
            frame.shows = frame.shows.shows
    return frames, channel


def _refuse_other_sizes(frames: Sequence[RecordedFrame]) -> None:
    """One camera's pictures have one size: that of most pictures with a board.

    Of two that are as frequent the larger: pictures whose lens somebody took out are cropped.
    """
    sizes = Counter(f.view.size for f in frames if f.view is not None)
    if not sizes:
        return
    usual = max(sizes, key=lambda size: (sizes[size], size[0] * size[1]))
    for frame in frames:
        if frame.view is not None and frame.view.size != usual and frame.reason is None:
            frame.refuse(
                Reason.WRONG_SIZE,
                f"the picture is {frame.view.size[0]}×{frame.view.size[1]} px, expected {usual[0]}×{usual[1]} like the "
                "others",
            )


def _read_stripes(frames: Sequence[RecordedFrame], places: Sequence[Place], laser: Laser | None) -> Channel:
    """Read the stripe of each board in its own picture or in another of its place, and set the others aside."""
    sources = [place.sources() for place in places]
    boards = {id(f) for place in places for f in (place.board, *place.others)}
    own = [f for f in frames if f.view is not None and f.reason is None]
    alone = [Source(f.path, f.view) for f in own if id(f) not in boards and f.view is not None]
    channel = choose_channel([source for some in sources for _, source in some] + alone, laser)
    for place, some in zip(places, sources, strict=True):
        _read_place(place, some, channel)
    for frame in own:
        if frame.reason is None and frame.profile is None and frame.view is not None:
            _take(frame, read_on_board(Source(frame.path, frame.view), channel))
    return channel


def _read_place(place: Place, sources: Sequence[tuple[RecordedFrame, Source]], channel: Channel) -> None:
    """The stripe of a place, from the picture that is named after the laser or shows it."""
    board = place.board
    assert board.view is not None
    reads = [(frame, source, read_on_board(source, channel)) for frame, source in sources]
    lit = max((r for r in reads if r[2].profile is not None), key=lambda r: r[2].points, default=None)
    if lit is None or not named_lit(lit[0]):
        dark = place.dark[0].path if place.dark else None
        mine = read_on_board(Source(board.path, board.view, dark), channel)
        if mine.profile is not None:
            _take(board, mine)
            lit = None
    if lit is not None:
        frame, source, read = lit
        _take(board, read)
        board.stripe_from = frame.name
        off = next((f for f in (board, *place.others) if f.path == source.off), None) if read.off else None
        board.stripe_off = off.name if off is not None else ""
        frame.refuse(Reason.LASER_PICTURE, f"the laser's picture of {board.name}")
        if off is not None and off is not board:
            off.refuse(Reason.LASER_PICTURE, f"the picture without the laser of {board.name}")
    for frame in place.others:
        frame.shows = board
        if frame.reason is None:
            frame.refuse(Reason.DUPLICATE, f"it shows what {board.name} shows")


def _take(frame: RecordedFrame, read: ReadStripe) -> None:
    frame.profile, frame.stripe_text, frame.stripe_left_out = read.profile, read.text, read.left_out


def read_pose_pairs(folder: Path) -> list[tuple[pin.SE3, pin.SE3]]:
    """Pairs (base_from_flange, camera_from_board) from the folder's JSON files; empty when none holds such a list.

    Raises ConfigError for a list of pairs with a matrix that is no pose.
    """
    for path in sorted(folder.glob("*.json")):
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            pairs: Array = np.asarray(data, dtype=np.float64)
        except (ValueError, TypeError, OSError, RecursionError):
            continue
        if pairs.ndim != 4 or pairs.shape[1:] != (2, 4, 4):
            continue
        for k, pair in enumerate(pairs):
            if not np.isfinite(pair).all():
                raise ConfigError(
                    f"{path}: pair {k} holds a value that is no finite number; correct or remove the pair"
                )
        try:
            return [(from_matrix(a), from_matrix(b)) for a, b in pairs]
        except ValueError as error:
            raise ConfigError(f"{path}: {error}") from error
    return []


def used(frames: Sequence[RecordedFrame]) -> list[RecordedFrame]:
    """The frames that were not refused."""
    return [f for f in frames if f.reason is None and f.view is not None]

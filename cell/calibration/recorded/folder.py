"""Recorded frames: pictures with the board and the stripe in each, the flange pose, and why one is not used.

The stripe may be in the picture of the board or in a second one, taken at the same place with the laser on.
How it is read is the business of `stripes.py`.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.listing import PICTURES, Listing
from cell.calibration.recorded.matching import frame_key
from cell.calibration.recorded.stripes import Channel, ReadStripe, Source, choose_channel, read_on_board
from cell.geometry.camera import Array
from cell.geometry.poses import from_matrix
from cell.vision.board.board import find_board
from cell.vision.board.spec import BoardSpec
from cell.vision.board.view import BoardView
from cell.vision.pictures import PictureRefused, Reason, read_picture
from cell.vision.stripe.extract import Laser, StripeProfile
from drivers.errors import ConfigError

# Two pictures show the board at one place when its points differ by no more than this.
SAME_PLACE_PX = 2.0
LASER_WORDS = re.compile(r"laser|stripe|(?<![a-z])(?:line|las|on)(?![a-z])")


@dataclass(eq=False)
class RecordedFrame:
    """One picture of a folder: what is seen in it, its pose, or `reason` and `text` why it is not used.

    `name` is below the folder; `pose_from` the file of the pose, `stripe_from` that of a second picture with the laser,
    `stripe_off` that of the picture without it that was taken off. `stripe_text` says why a line is not believed;
    `stripe_left_out` how many points on the board are marked, by the mark.
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

    def refuse(self, reason: Reason, text: str) -> None:
        """Set the frame aside."""
        self.reason, self.text = reason, text


def read_frames(
    listing: Listing, spec: BoardSpec, links: Sequence[dict[str, str]] = (), laser: Laser = Laser.AUTO
) -> tuple[list[RecordedFrame], Channel]:
    """Every picture of a listing, with board and stripe, or refused with a reason; and where the laser was read.

    `links` are pictures that a table names together. Raises ConfigError when there are no pictures.
    """
    if not listing.pictures:
        raise ConfigError(f"{listing.folder} holds no pictures ({', '.join(PICTURES)})")
    frames = [RecordedFrame(path, listing.name(path)) for path in listing.pictures]
    seen: dict[str, str] = {}
    for frame in frames:
        try:
            frame.view = find_board(read_picture(frame.path), spec)
        except PictureRefused as refused:
            frame.refuse(refused.reason, str(refused))
        if frame.reason not in (Reason.UNREADABLE, Reason.CUT):
            digest = frame_key(frame.name) + hashlib.sha1(frame.path.read_bytes(), usedforsecurity=False).hexdigest()
            if digest in seen:
                frame.refuse(Reason.DUPLICATE, f"the same file as {seen[digest]}")
            seen.setdefault(digest, frame.name)
    _refuse_other_sizes(frames)
    return frames, _read_stripes(frames, _pairs(frames, links), laser)


def _refuse_other_sizes(frames: Sequence[RecordedFrame]) -> None:
    """One camera's pictures have one size: that of most pictures with a board."""
    sizes = Counter(f.view.size for f in frames if f.view is not None)
    if not sizes:
        return
    usual = sizes.most_common(1)[0][0]
    for frame in frames:
        if frame.view is not None and frame.view.size != usual and frame.reason is None:
            frame.refuse(
                Reason.WRONG_SIZE,
                f"the picture is {frame.view.size[0]}×{frame.view.size[1]} px, expected {usual[0]}×{usual[1]} like the "
                "others",
            )


def _pairs(frames: list[RecordedFrame], links: Sequence[dict[str, str]]) -> list[tuple[RecordedFrame, RecordedFrame]]:
    """Pictures of one place: that of the board, and a second one that may show the laser."""
    by_key: dict[str, list[RecordedFrame]] = {}
    for frame in frames:
        if frame.reason is not Reason.DUPLICATE:
            by_key.setdefault(frame_key(frame.name), []).append(frame)
    pairs = []
    for group in [group for key, group in by_key.items() if key and len(group) == 2] + _linked(frames, links):
        board, second = _roles(group)
        usable = board.view is not None and board.reason is None
        unreadable = second.reason in (Reason.UNREADABLE, Reason.CUT)
        if not usable or unreadable or _apart(board.view, second.view) > SAME_PLACE_PX:
            continue
        pairs.append((board, second))
    return pairs


def _read_stripes(
    frames: list[RecordedFrame], pairs: Sequence[tuple[RecordedFrame, RecordedFrame]], laser: Laser
) -> Channel:
    """Read the stripe of each board in its own picture or in its second one, and set the second ones aside."""
    sources = [Source(second.path, board.view, board.path) for board, second in pairs if board.view is not None]
    paired = {id(frame) for pair in pairs for frame in pair}
    own = [f for f in frames if f.view is not None and f.reason is None]
    channel = choose_channel(
        sources + [Source(f.path, f.view) for f in own if id(f) not in paired and f.view is not None], laser
    )
    for (board, second), source in zip(pairs, sources, strict=True):
        named = LASER_WORDS.search(second.name.lower()) is not None
        read = read_on_board(source, channel)
        mine = None if named or board.view is None else read_on_board(Source(board.path, board.view), channel)
        alike = second.view is not None
        if read.profile is not None and (named or (not alike and (mine is None or mine.profile is None))):
            _take(board, read)
            board.stripe_from, board.stripe_off = second.name, board.name if read.off else ""
            second.refuse(Reason.LASER_PICTURE, f"the laser's picture of {board.name}")
        elif alike:
            second.refuse(Reason.DUPLICATE, f"it shows what {board.name} shows")
    for frame in own:
        if frame.reason is None and frame.profile is None and frame.view is not None:
            _take(frame, read_on_board(Source(frame.path, frame.view), channel))
    return channel


def _take(frame: RecordedFrame, read: ReadStripe) -> None:
    frame.profile, frame.stripe_text, frame.stripe_left_out = read.profile, read.text, read.left_out


def _linked(frames: Sequence[RecordedFrame], links: Sequence[dict[str, str]]) -> list[list[RecordedFrame]]:
    named = {f.name: f for f in frames}
    pairs = []
    for link in links:
        group = [named[v] for v in link.values() if v in named]
        if len(group) == 2:
            lit = [named[v] for k, v in link.items() if v in named and LASER_WORDS.search(k.lower())]
            pairs.append([g for g in group if g not in lit] + lit)
    return pairs


def _roles(group: Sequence[RecordedFrame]) -> tuple[RecordedFrame, RecordedFrame]:
    """The board's picture and the second one: by their names, else that without a board, else the longer name.

    Of a picture in two formats the larger file lost less.
    """
    lit = [LASER_WORDS.search(f.name.lower()) is not None for f in group]
    if lit[0] != lit[1]:
        return (group[1], group[0]) if lit[0] else (group[0], group[1])
    if (group[0].view is None) != (group[1].view is None):
        return (group[1], group[0]) if group[0].view is None else (group[0], group[1])
    first, second = sorted(group, key=lambda f: (len(f.name), -f.path.stat().st_size))
    return first, second


def _apart(a: BoardView | None, b: BoardView | None) -> float:
    """Median distance in px of the same points of two views; infinite for other sizes, 0 where one is not seen."""
    if a is None or b is None:
        return 0.0
    if a.size != b.size:
        return float("inf")
    best = float("inf")
    for turned in b.turns():
        _, here, there = np.intersect1d(a.ids, turned.ids, return_indices=True)
        if len(here):
            best = min(best, float(np.median(np.linalg.norm(a.pixels[here] - turned.pixels[there], axis=1))))
    return best


def read_pose_pairs(folder: Path) -> list[tuple[pin.SE3, pin.SE3]]:
    """Pairs (base_from_flange, camera_from_board) from the folder's JSON files; empty when none holds such a list.

    Raises ConfigError for a list of pairs with a matrix that is no pose.
    """
    for path in sorted(folder.glob("*.json")):
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            pairs: Array = np.asarray(data, dtype=np.float64)
        except (ValueError, TypeError, OSError):
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

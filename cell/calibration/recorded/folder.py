"""Recorded frames: pictures with the board and the stripe in each, the flange pose, and why one is not used.

The stripe may be in the picture of the board or in a second one, taken at the same place with the laser on.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.calibration.recorded.listing import PICTURES, Listing
from cell.calibration.recorded.matching import frame_key
from cell.geometry.camera import Array
from cell.geometry.poses import from_matrix
from cell.vision.board.board import find_board
from cell.vision.board.spec import BoardSpec
from cell.vision.board.view import BoardView
from cell.vision.pictures import Image, PictureRefused, Reason, read_picture
from cell.vision.stripe.extract import StripeProfile, extract
from drivers.errors import ConfigError

# A laser stripe is brighter than the board's white, and runs on from row to row.
LASER_OVER_WHITE = 1.2
LEAST_SMOOTH_ROWS = 30
LEAST_SMOOTH_SHARE = 0.05
# What is flat with the board reaches about so many pitches beyond its outermost points. There the stripe is straight,
# to so many px but for a lens, in so many of its rows.
AROUND = 5.0
STRAIGHT_PX, LEAST_STRAIGHT = 3.0, 0.6
# Two pictures show the board at one place when its points differ by no more than this.
SAME_PLACE_PX = 2.0
LASER_WORDS = re.compile(r"laser|stripe|(?<![a-z])(?:line|las|on)(?![a-z])")


@dataclass(eq=False)
class RecordedFrame:
    """One picture of a folder: what is seen in it, its pose, or `reason` and `text` why it is not used.

    `name` is below the folder; `pose_from` the file of the pose, `stripe_from` that of a second picture with the laser.
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

    def refuse(self, reason: Reason, text: str) -> None:
        """Set the frame aside."""
        self.reason, self.text = reason, text


def read_frames(listing: Listing, spec: BoardSpec, links: Sequence[dict[str, str]] = ()) -> list[RecordedFrame]:
    """Every picture of a listing, with board and stripe, or refused with a reason.

    `links` are pictures that a table names together. Raises ConfigError when there are no pictures.
    """
    if not listing.pictures:
        raise ConfigError(f"{listing.folder} holds no pictures ({', '.join(PICTURES)})")
    frames = [RecordedFrame(path, listing.name(path)) for path in listing.pictures]
    seen: dict[str, str] = {}
    for frame in frames:
        try:
            frame.view, frame.profile = _look(frame.path, spec)
        except PictureRefused as refused:
            frame.refuse(refused.reason, str(refused))
        if frame.reason not in (Reason.UNREADABLE, Reason.CUT):
            digest = frame_key(frame.name) + hashlib.sha1(frame.path.read_bytes(), usedforsecurity=False).hexdigest()
            if digest in seen:
                frame.refuse(Reason.DUPLICATE, f"the same file as {seen[digest]}")
            seen.setdefault(digest, frame.name)
    _refuse_other_sizes(frames)
    _join_pairs(frames, links)
    return frames


def _look(path: Path, spec: BoardSpec) -> tuple[BoardView, StripeProfile | None]:
    image = read_picture(path)
    view = find_board(image, spec)
    return view, find_stripe(image, view)


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


def _join_pairs(frames: list[RecordedFrame], links: Sequence[dict[str, str]]) -> None:
    """Take the stripe of a board's picture from its second picture, and set second pictures of one frame aside."""
    by_key: dict[str, list[RecordedFrame]] = {}
    for frame in frames:
        if frame.reason is not Reason.DUPLICATE:
            by_key.setdefault(frame_key(frame.name), []).append(frame)
    pairs = [group for key, group in by_key.items() if key and len(group) == 2] + _linked(frames, links)
    for group in pairs:
        board, second = _roles(group)
        if board.view is None or board.reason is not None:
            continue
        profile, named = second.profile, LASER_WORDS.search(second.name.lower()) is not None
        if second.view is not None:
            if _apart(board.view, second.view) > SAME_PLACE_PX:
                continue
            if second.profile is None or not named:
                second.refuse(Reason.DUPLICATE, f"it shows what {board.name} shows")
                continue
        else:
            profile = _stripe_of(second.path, board.view)
        if profile is not None and (named or board.profile is None):
            board.profile, board.stripe_from = profile, second.name
            second.refuse(Reason.LASER_PICTURE, f"the laser's picture of {board.name}")


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


def _apart(a: BoardView, b: BoardView) -> float:
    """Median distance in px of the same points of two views; infinite for other sizes."""
    if a.size != b.size:
        return float("inf")
    best = float("inf")
    for turned in b.turns():
        _, here, there = np.intersect1d(a.ids, turned.ids, return_indices=True)
        if len(here):
            best = min(best, float(np.median(np.linalg.norm(a.pixels[here] - turned.pixels[there], axis=1))))
    return best


def _stripe_of(path: Path, view: BoardView) -> StripeProfile | None:
    try:
        image = read_picture(path)
    except PictureRefused:
        return None
    return find_stripe(image, view) if (image.shape[1], image.shape[0]) == view.size else None


def find_stripe(image: Image, view: BoardView) -> StripeProfile | None:
    """The laser stripe on the board of a picture, along rows or columns; None when no laser is on the board."""
    low, high = np.clip(view.pixels.min(axis=0), 0, None).astype(int), view.pixels.max(axis=0).astype(int) + 1
    white = float(np.percentile(image[low[1] : high[1], low[0] : high[0]], 75))
    board = _sheet(image, view)
    best: tuple[int, StripeProfile] | None = None
    for axis in ("rows", "columns"):
        profile = extract(image, axis="rows" if axis == "rows" else "columns")
        if len(profile.rows) < LEAST_SMOOTH_ROWS:
            continue
        # Where, on the board, three neighbouring rows have centres on a line, within a pixel.
        at = np.round(profile.pixels()).astype(int)
        lit = board[at[:, 1], at[:, 0]] > 0
        on_board = np.zeros(len(profile.centres), dtype=np.bool_)
        on_board[profile.rows[lit]] = True
        follows = np.zeros(len(on_board), dtype=np.bool_)
        follows[1:-1] = (np.abs(np.diff(profile.centres, 2)) < 1.0) & on_board[1:-1]
        smooth = _straight(profile.centres, follows)
        level = float(np.median(image[at[lit, 1], at[lit, 0]])) if lit.any() else 0.0
        enough = smooth > max(LEAST_SMOOTH_ROWS, LEAST_SMOOTH_SHARE * len(profile.centres))
        if enough and level > min(LASER_OVER_WHITE * white + 5, 250) and (best is None or smooth > best[0]):
            best = smooth, profile
    return None if best is None else best[1]


def _straight(centres: Array, follows: NDArray[np.bool_]) -> int:
    """How many of the rows (n,) that follow their neighbours lie on one line; 0 where that is not most of them."""
    rows = np.flatnonzero(follows)
    if len(rows) < LEAST_SMOOTH_ROWS:
        return 0
    points = np.column_stack([rows, centres[rows]]).astype(np.float32)
    dx, dy, x, y = cv2.fitLine(points, cv2.DIST_WELSCH, 0, 0.01, 0.01).ravel()
    near = int((np.abs((points[:, 0] - x) * dy - (points[:, 1] - y) * dx) < STRAIGHT_PX).sum())
    return near if near > LEAST_STRAIGHT * len(rows) else 0


def _sheet(image: Image, view: BoardView) -> Image:
    """Mask (h, w) of the board with what is around its points: outer squares and margin."""
    flat = view.object_points[:, :2] / view.spec.pitch
    homography, _ = cv2.findHomography(flat, view.pixels)
    mask = np.zeros(image.shape, np.uint8)
    (x0, y0), (x1, y1) = flat.min(axis=0) - AROUND, flat.max(axis=0) + AROUND
    corners = np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]]], dtype=np.float64)
    cv2.fillConvexPoly(mask, np.round(cv2.perspectiveTransform(corners, homography)[0]).astype(np.int32), 1)
    return mask


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

"""Pictures of one place: which of them shows the board, which the laser, which neither, and which only once more.

They have the same name but for words such as laser or off, or a table names them together, or they show the same.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cell.calibration.recorded.matching import frame_key
from cell.calibration.recorded.stripes import Source, calmest
from cell.vision.board.view import BoardView
from cell.vision.pictures import Reason

if TYPE_CHECKING:
    from cell.calibration.recorded.folder import RecordedFrame

# Pictures that are named alike show the board at one place when its points differ by no more than the first. Those of
# other numbers are one view when they differ by the second, which is what noise and another file format make.
SAME_PLACE_PX, SAME_VIEW_PX = 2.0, 0.1
# Views whose middles differ by more are not compared.
FAR_PX = 20.0
LASER_WORDS = re.compile(r"laser|stripe|(?<![a-z])(?:line|las|on)(?![a-z])")
OFF_WORDS = re.compile(r"(?<![a-z])(?:off|no|without)(?![a-z])|laseroff|nolaser")


@dataclass(frozen=True)
class Place:
    """The picture that shows the `board`, and the `others` of the same place."""

    board: RecordedFrame
    others: list[RecordedFrame]

    @property
    def dark(self) -> list[RecordedFrame]:
        """Pictures without the laser, by their names."""
        return [f for f in self.others if named_off(f)]

    @property
    def lit(self) -> list[RecordedFrame]:
        """Pictures that may show the laser: by their names, else all that are not said to be without it."""
        return [f for f in self.others if named_lit(f)] or [f for f in self.others if not named_off(f)]

    def sources(self) -> list[tuple[RecordedFrame, Source]]:
        """Where the stripe may be, each with the picture without the laser that takes most of the board away."""
        assert self.board.view is not None
        offs = [f.path for f in (*self.dark, self.board)]
        return [(f, Source(f.path, self.board.view, calmest(f.path, offs, self.board.view))) for f in self.lit]


def named_off(frame: RecordedFrame) -> bool:
    """True for a picture whose name says that the laser is off."""
    return OFF_WORDS.search(frame.name.lower()) is not None


def named_lit(frame: RecordedFrame) -> bool:
    """True for a picture whose name says that the laser is on."""
    return LASER_WORDS.search(frame.name.lower()) is not None and not named_off(frame)


def find_places(frames: Sequence[RecordedFrame], links: Sequence[dict[str, str]]) -> list[Place]:
    """Places of which there are several pictures; `links` are pictures that a table names together."""
    out = (Reason.DUPLICATE, Reason.UNREADABLE, Reason.CUT, Reason.WRONG_SIZE)
    usable = [f for f in frames if f.reason not in out and (f.view is None or f.reason is None)]
    groups = _together(usable, links)
    places = []
    for group in groups:
        seen = [f for f in group if f.view is not None]
        dark = [f for f in group if f.view is None]
        while seen:
            board = _board(seen, frames)
            near = [f for f in seen if apart(board.view, f.view) <= SAME_PLACE_PX]
            # A picture without the board belongs to the place of its name, if there is one.
            alone = len(near) == len(seen) == len([f for f in group if f.view is not None])
            others = [f for f in near if f is not board] + (dark if alone else [])
            if others:
                places.append(Place(board, others))
            seen = [f for f in seen if f not in near]
    return places


def _together(frames: Sequence[RecordedFrame], links: Sequence[dict[str, str]]) -> list[list[RecordedFrame]]:
    """Frames by what joins them, names, links or views; those that nothing joins to another are left out."""
    group = list(range(len(frames)))

    def join(a: int, b: int) -> None:
        old, new = group[b], group[a]
        group[:] = [new if g == old else g for g in group]

    first: dict[str, int] = {}
    for k, frame in enumerate(frames):
        key = frame_key(frame.name)
        if key:
            join(first.setdefault(key, k), k)
    index = {f.name: k for k, f in enumerate(frames)}
    for link in links:
        linked = [index[v] for v in link.values() if v in index]
        for k in linked[1:]:
            join(linked[0], k)
    seen = [k for k, f in enumerate(frames) if f.view is not None]
    middles = np.array([np.median(v.pixels, axis=0) for f in frames if (v := f.view) is not None]).reshape(-1, 2)
    for i, k in enumerate(seen):
        near = np.flatnonzero(np.abs(middles[:i] - middles[i]).max(axis=1) < FAR_PX)
        for j in near:
            if group[seen[j]] != group[k] and apart(frames[seen[j]].view, frames[k].view) < SAME_VIEW_PX:
                join(seen[j], k)
    by_group: dict[int, list[RecordedFrame]] = {}
    for k, frame in enumerate(frames):
        by_group.setdefault(group[k], []).append(frame)
    return [g for g in by_group.values() if len(g) > 1]


def _board(seen: Sequence[RecordedFrame], frames: Sequence[RecordedFrame]) -> RecordedFrame:
    """The board's picture: one not named after the laser, of the first number, with the shortest name.

    Of a picture in two formats the larger file lost less.
    """
    first: dict[str, int] = {}
    for k, frame in enumerate(frames):
        first.setdefault(frame_key(frame.name), k)

    def order(frame: RecordedFrame) -> tuple[bool, bool, int, int, int]:
        size = -frame.path.stat().st_size
        return named_lit(frame), named_off(frame), first[frame_key(frame.name)], len(frame.name), size

    return min(seen, key=order)


def apart(a: BoardView | None, b: BoardView | None) -> float:
    """Median distance in px of the same points of two views, in any order that the board allows.

    Infinite for other sizes, and where few points are seen in both.
    """
    if a is None or b is None or a.size != b.size:
        return float("inf")
    best = float("inf")
    for turned in b.turns():
        _, here, there = np.intersect1d(a.ids, turned.ids, return_indices=True)
        if 2 * len(here) >= max(len(a.ids), len(b.ids)):
            best = min(best, float(np.median(np.linalg.norm(a.pixels[here] - turned.pixels[there], axis=1))))
    return best

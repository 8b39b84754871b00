"""The laser stripe on the board of recorded pictures: in colour or grey, with a picture without the laser or not.

One laser made all pictures of a recording: what it stands out in is chosen from all of them together. A line that may
be the board's own pattern is not taken.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.view import BoardView
from cell.measure.vision.pictures import PictureRefused
from cell.measure.vision.stripe.extract import extract, subtracted
from cell.measure.vision.stripe.planes import MIXES, LaserChannel, Picture, read_colours
from cell.measure.vision.stripe.profile import Mark, StripeProfile, StripeSettings

Shot = NDArray[np.uint8] | NDArray[np.uint16]

LOOKED_AT = 8
"""Pictures, spread over a recording, that say in what the laser stands out."""
# A laser stripe is brighter than the board's white, and runs on from row to row.
LASER_OVER_WHITE, OVER_DN = 1.2, 5.0
LEAST_SMOOTH_ROWS = 30
SATURATED_DN, OUTSIDE_DN = 250.0, -1e6
BESIDE_PX = 14
"""A stripe's half-width and its halo are less; there it is darker than in its middle."""
LEAST_SMOOTH_SHARE = 0.05
# What is flat with the board reaches about so many pitches beyond its outermost points. There the stripe is straight,
# to so many px but for a lens, in so many of its rows.
AROUND = 5.0
STRAIGHT_PX, LEAST_STRAIGHT = 3.0, 0.6
MOST_MARKED = 0.5
CALMER = 0.5
"""A picture without the laser is taken off where it leaves no more than this share of what varies on the board."""
NEXT = "Take colour pictures, or a second one of each view with the laser off (NAME_on, NAME_off), or name the --laser"


@dataclass(frozen=True)
class Source:
    """Where a stripe may be: a picture, the board `view` of its place, and the file of a picture without the laser."""

    path: Path
    view: BoardView
    off: Path | None = None

    def picture(self) -> Shot | None:
        """The picture in colour, None where it cannot be read or has another size than the board's."""
        try:
            image = read_colours(self.path)
        except PictureRefused:
            return None
        return image if (image.shape[1], image.shape[0]) == self.view.size else None

    def sheet(self) -> NDArray[np.bool_]:
        """Mask (h, w) of the board with what is around its points: outer squares and margin."""
        flat = self.view.object_points[:, :2] / self.view.spec.pitch
        homography, _ = cv2.findHomography(flat, self.view.pixels)
        mask = np.zeros(self.view.size[::-1], np.uint8)
        (x0, y0), (x1, y1) = flat.min(axis=0) - AROUND, flat.max(axis=0) + AROUND
        corners = np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]]], dtype=np.float64)
        cv2.fillConvexPoly(mask, np.round(cv2.perspectiveTransform(corners, homography)[0]).astype(np.int32), 1)
        return mask > 0


@dataclass(frozen=True)
class ReadStripe:
    """The stripe on a board, or None and, where there is a line, the `text` why it is not believed.

    `left_out`: points on the board that a mark tells not to trust, by the mark; they are not in the profile. `off`:
    a picture without the laser was taken off. `points` on the board run on from row to row.
    """

    profile: StripeProfile | None = None
    text: str = ""
    left_out: dict[str, int] = field(default_factory=dict)
    off: bool = False
    points: int = 0


@dataclass(frozen=True)
class ChosenChannel:
    """In what the laser is read: what was `asked`, what was `chosen`, and the votes of pictures for each mix."""

    asked: LaserChannel | None
    chosen: LaserChannel | None
    votes: dict[str, int] = field(default_factory=dict)
    reads: dict[Path, ReadStripe] = field(default_factory=dict)
    """What was read in it already, by the picture."""

    def figures(self) -> dict[str, object]:
        """For the JSON."""
        return {"asked": str(self.asked or "none"), "channel": str(self.chosen or "none"), "votes": self.votes}


def choose_channel(sources: Sequence[Source], laser: LaserChannel | None) -> ChosenChannel:
    """What the laser is read in, in all pictures: as asked, or in what it stands out in most of those looked at. Where
    none of them shows it there was no laser."""
    if laser is not LaserChannel.AUTO or not sources:
        return ChosenChannel(laser, laser)
    some = [sources[k] for k in np.unique(np.linspace(0, len(sources) - 1, LOOKED_AT).astype(int))]
    # Most such recordings are of the board alone; to look for a line in every mix of colours takes seconds each.
    lit = [source for source in some if source.off is not None or _may_show_line(source)]
    reads = {source.path: read_on_board(source, ChosenChannel(laser, laser)) for source in lit}
    votes = Counter(_mix(read.profile) for read in reads.values() if read.profile is not None)
    if not votes:
        return ChosenChannel(laser, None, {}, reads)
    chosen = votes.most_common(1)[0][0]
    again = {path: read for path, read in reads.items() if read.profile is not None and _mix(read.profile) == chosen}
    return ChosenChannel(laser, LaserChannel(chosen), dict(votes.most_common()), again)


def _may_show_line(source: Source) -> bool:
    """Whether some mix of colours has a thin line on the board that is brighter than its white: a quick look."""
    image, sheet = source.picture(), source.sheet()
    if image is None:
        return False
    picture = subtracted(image, None, StripeSettings())[0]
    left, top, width, height = cv2.boundingRect(sheet.astype(np.uint8))
    box = slice(top, top + height), slice(left, left + width)
    for mix in MIXES if picture.coloured else ("grey",):
        plane = picture.plane(mix)[0]
        needed = _needed(_white(plane, source.view))
        part = np.where(sheet[box], cv2.GaussianBlur(plane[box], (0, 0), 1.0), OUTSIDE_DN)
        for lines in (part, part.T):
            wide = np.pad(lines, ((0, 0), (BESIDE_PX, BESIDE_PX)), constant_values=OUTSIDE_DN)
            beside = np.maximum(wide[:, : lines.shape[1]], wide[:, -lines.shape[1] :])
            ridge = np.where((lines > needed) & (beside > OUTSIDE_DN), lines - beside, OUTSIDE_DN)
            at = ridge.argmax(axis=1)
            lit = ridge.max(axis=1) > OVER_DN
            follows = lit & np.r_[False, lit[:-1] & (np.abs(np.diff(at)) <= STRAIGHT_PX)]
            if _straight(at.astype(np.float64), follows) > LEAST_SMOOTH_ROWS:
                return True
    return False


def _mix(profile: StripeProfile) -> str:
    return profile.learned.mix if profile.learned is not None else "grey"


def read_on_board(source: Source, channel: ChosenChannel) -> ReadStripe:
    """The stripe on the board of a picture, along rows or columns, whichever shows more of it."""
    if source.path in channel.reads or channel.chosen is None:
        return channel.reads.get(source.path, ReadStripe())
    image, sheet, off = source.picture(), source.sheet(), None
    if image is None:
        return ReadStripe()
    if source.off is not None:
        # A picture without the laser of another exposure would not take the board away.
        dark, left = _without(image, source.off, sheet)
        off = dark if left < CALMER else None
    found = []
    for axis in ("rows", "columns"):
        try:
            profile = extract(image, off, "rows" if axis == "rows" else "columns", laser=channel.chosen)
        except PictureRefused as refused:
            return ReadStripe(text=str(refused))
        except (ArithmeticError, LookupError, ValueError, cv2.error) as error:
            # One picture that upsets the search must not end the reading of the others.
            return ReadStripe(text=f"the search for the stripe failed: {type(error).__name__}: {error}")
        found.append(_on_board(profile, *subtracted(image, off, StripeSettings()), source.view, sheet))
    sure = [f for f in found if f.profile is not None] or found
    return replace(max(sure, key=lambda f: f.points), off=off is not None)


def _on_board(
    profile: StripeProfile, picture: Picture, off: Picture | None, view: BoardView, sheet: NDArray[np.bool_]
) -> ReadStripe:
    """A profile of which enough lies on the board in a line that is brighter than the board."""
    if len(profile.rows) < LEAST_SMOOTH_ROWS:
        return ReadStripe()
    # Where, on the board, three neighbouring rows have centres on a line, within a pixel.
    at = np.clip(np.round(profile.pixels()).astype(int), 0, np.array(view.size) - 1)
    lit = sheet[at[:, 1], at[:, 0]]
    on_board = np.zeros(len(profile.centres), dtype=np.bool_)
    on_board[profile.rows[lit]] = True
    follows = np.zeros(len(on_board), dtype=np.bool_)
    follows[1:-1] = (np.abs(np.diff(profile.centres, 2)) < 1.0) & on_board[1:-1]
    smooth = _straight(profile.centres, follows)
    if smooth <= max(LEAST_SMOOTH_ROWS, LEAST_SMOOTH_SHARE * len(profile.centres)):
        return ReadStripe(points=smooth)
    mix = _mix(profile)
    plane = picture.plane(mix)[0] if off is None else picture.plane(mix)[0] - off.plane(mix)[0]
    levels, white = plane[at[lit, 1], at[lit, 0]], _white(plane, view)
    level, needed = float(np.median(levels)), _needed(white)
    hull = cv2.convexHull(view.pixels.astype(np.float32))
    among = np.array([cv2.pointPolygonTest(hull, (float(x), float(y)), False) > 0 for x, y in profile.pixels()[lit]])
    if level > needed and among.sum() >= LEAST_SMOOTH_ROWS:
        # Edges of the squares are no brighter there than the white, whatever shines outside.
        level = min(level, float(np.percentile(levels[among], 75)))
    if level <= needed:
        text = (
            f"a line of {smooth} points lies on the board, but at {level:.0f} DN it is not clearly brighter than the "
            f"board's white with {white:.0f} DN (in {mix}; needed is {needed:.0f}): it may be the board's own. {NEXT}"
        )
        return ReadStripe(None, text, points=smooth)
    # Points that a second line or a reflection may have moved do not count. A mark of most points tells nothing of
    # single ones: faint light all along a stripe is its halo, and they stay.
    second, faint = ((profile.marks & np.uint8(mark)) > 0 for mark in (Mark.SECOND_LINE, Mark.REFLECTION))
    rest = on_board & ~second
    if (faint & rest).sum() > MOST_MARKED * rest.sum():
        faint = np.zeros_like(faint)
    keep = ~(second | faint)
    left_out = {"second_line": int((second & on_board).sum()), "reflection": int((faint & rest).sum())}
    whole, left = int(on_board.sum()), int((on_board & keep).sum())
    if left_out["second_line"] > MOST_MARKED * whole or left < LEAST_SMOOTH_ROWS:
        text = (
            f"of the {whole} points of a line on the board {left_out['second_line']} have a second line beside them "
            f"(allowed {MOST_MARKED:.0%}), {left} have neither that nor a reflection (needed {LEAST_SMOOTH_ROWS}): "
            f"which line is the laser's is not sure. {NEXT}"
        )
        return ReadStripe(None, text, left_out, points=smooth)
    return ReadStripe(replace(profile, centres=np.where(keep, profile.centres, np.nan)), "", left_out, points=smooth)


def _white(plane: NDArray[np.float32], view: BoardView) -> float:
    low, high = np.clip(view.pixels.min(axis=0), 0, None).astype(int), view.pixels.max(axis=0).astype(int) + 1
    return float(np.percentile(plane[low[1] : high[1], low[0] : high[0]], 75))


def _needed(white: float) -> float:
    """How bright in DN a line has to be on such a board."""
    return min(LASER_OVER_WHITE * max(white, 0.0) + OVER_DN, SATURATED_DN)


def calmest(path: Path, offs: Sequence[Path], view: BoardView) -> Path:
    """Of pictures without the laser, one or more, the one that takes most of the board away from the picture `path`."""
    source = Source(path, view)
    image = source.picture() if len(offs) > 1 else None
    if image is None:
        return offs[0]
    sheet = source.sheet()
    return min(offs, key=lambda off: _without(image, off, sheet)[1])


def _without(image: Shot, path: Path, sheet: NDArray[np.bool_]) -> tuple[Shot | None, float]:
    """The picture without the laser, and the share of what varies on the board that is left when it is taken off."""
    try:
        off = read_colours(path)
    except PictureRefused:
        return None, float("inf")
    if off.shape[:2] != image.shape[:2] or off.dtype != image.dtype:
        return None, float("inf")
    lit, dark = (picture.mean(axis=2) if picture.ndim == 3 else picture.astype(float) for picture in (image, off))
    before, after = (np.percentile(part[sheet], (10, 90)) for part in (lit, lit - dark))
    return off, float(np.ptp(after) / max(np.ptp(before), 1.0))


def _straight(centres: Array, follows: NDArray[np.bool_]) -> int:
    """How many of the rows (n,) that follow their neighbours lie on one line; 0 where that is not most of them."""
    rows = np.flatnonzero(follows)
    if len(rows) < LEAST_SMOOTH_ROWS:
        return 0
    points = np.column_stack([rows, centres[rows]]).astype(np.float32)
    dx, dy, x, y = cv2.fitLine(points, cv2.DIST_WELSCH, 0, 0.01, 0.01).ravel()
    near = int((np.abs((points[:, 0] - x) * dy - (points[:, 1] - y) * dx) < STRAIGHT_PX).sum())
    return near if near > LEAST_STRAIGHT * len(rows) else 0

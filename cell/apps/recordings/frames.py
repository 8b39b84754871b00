"""Recorded frames: pictures with the board and the stripe in each, the flange pose, and why one is not used.

Some pictures belong together: copies, what a program drew into, those of one place with the laser on and off, and those
of one stop of the arm. How a stripe is read is the business of `stripes.py`.
"""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cell.apps.recordings.result import Figures
from cell.apps.recordings.series import Listing, frame_key
from cell.apps.recordings.stripes import ChosenChannel, ReadStripe, Source, calmest, choose_channel, read_on_board
from cell.apps.recordings.texts import PICTURES
from cell.measure.geometry.poses import difference, mean
from cell.measure.vision.board.board import find_board
from cell.measure.vision.board.view import BoardSpec, BoardView
from cell.measure.vision.pictures import PictureRefused, Reason, read_picture
from cell.measure.vision.stripe.planes import LaserChannel, range_of, read_colours
from cell.measure.vision.stripe.profile import StripeProfile
from drivers.errors import ConfigError

Small = NDArray[np.float32]
SMALL, ALIKE_DN = (40, 30), 12.0
"""Small copies of one view differ by less on average; which views are worth a closer look."""
SAME_DN, CHANGED_DN, LARGEST_SHARE = 6.0, 40, 0.2
"""Half of the pixels differ by less than the first; what differs by more than the second was drawn: a small share."""
COLOURED_DN, COLOURED_SHARE = 60, 0.6
"""Drawn pixels are by so much more coloured than before; most of them are."""
THICK = 80
"""Lines are thinner than the picture's width over this."""
HUES, HUE_SHARE = 6, 0.15
"""A laser's line has one hue; axes, markers and corners have several, or are at most of the board's points."""
AT_POINTS, NEAR_PX = 0.6, 6
# Pictures that are named alike show the board at one place when its points differ by no more than the first. Those of
# other numbers are one view when they differ by the second, which is what noise and another file format make. Views
# whose middles differ by more than the third are not compared.
SAME_PLACE_PX, SAME_VIEW_PX, FAR_PX = 2.0, 0.1, 20.0
STRAIGHTENED = re.compile(r"undist|rectif|remap|straight", re.IGNORECASE)
LASER_WORDS = re.compile(r"laser|stripe|(?<![a-z])(?:line|las|on)(?![a-z])")
OFF_WORDS = re.compile(r"(?<![a-z])(?:off|no|without)(?![a-z])|laseroff|nolaser")
# Two pictures are of one stop when their boards lie at the same pixels, as well as a corner is found in a poor
# picture, and their flange poses, where there are any, differ by no more than a standing arm's reading does.
SAME_PX, SAME_M, SAME_RAD, LEAST_SHARED = 0.5, 5e-4, 1e-3, 0.5


@dataclass(eq=False)
class RecordedFrame:
    """One picture of a folder: what is seen in it, its pose, or `reason` and `text` why it is not used.

    `name` is below the folder; `pose_from` the file of the pose, `stripe_from` that of a second picture with the laser,
    `stripe_off` that of the picture without it that was taken off. `stripe_text` says why a line is not believed;
    `stripe_left_out` how many points on the board are marked, by the mark. `rms_px`: by how much the board's points
    miss their places. `shows`: the frame of the same place that is used in its stead.
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
    rms_px: float | None = None
    shows: "RecordedFrame | None" = None

    def refuse(self, reason: Reason, text: str) -> None:
        """Set the frame aside."""
        self.reason, self.text = reason, text

    def take(self, read: ReadStripe) -> None:
        """Keep what was read of the stripe."""
        self.profile, self.stripe_text, self.stripe_left_out = read.profile, read.text, read.left_out

    def figures(self) -> Figures:
        """What became of it, for the JSON."""
        return {
            "name": self.name, "used": self.reason is None,
            "reason": None if self.reason is None else str(self.reason), "text": self.text, "rms_px": self.rms_px,
            "points": 0 if self.view is None else len(self.view.ids), "pose": self.base_from_flange is not None,
            **{name: getattr(self, name) or None for name in ("pose_from", "stripe_from", "stripe_off")},
            "stripe": self.profile is not None, "stripe_text": self.stripe_text,
            "stripe_left_out": self.stripe_left_out,
            "order_assumed": self.view is not None and self.view.order_assumed,
        }  # fmt: skip

    @property
    def dark(self) -> bool:
        """True where the name says that the laser is off."""
        return OFF_WORDS.search(self.name.lower()) is not None

    @property
    def lit(self) -> bool:
        """True where the name says that the laser is on."""
        return LASER_WORDS.search(self.name.lower()) is not None and not self.dark


def used(frames: Sequence[RecordedFrame]) -> list[RecordedFrame]:
    """The frames that were not refused."""
    return [f for f in frames if f.reason is None and f.view is not None]


def read_frames(
    listing: Listing,
    spec: BoardSpec,
    links: Sequence[dict[str, str]] = (),
    laser: LaserChannel | None = LaserChannel.AUTO,
) -> tuple[list[RecordedFrame], ChosenChannel]:
    """Every picture of a listing, with board and stripe, or refused with a reason; and where the laser was read.

    `links` are pictures that a table names together; `laser` None looks for no stripe. Raises ConfigError where there
    are no pictures.
    """
    if not listing.pictures:
        raise ConfigError(f"{listing.folder} holds no pictures ({', '.join(PICTURES)})")
    frames = [RecordedFrame(path, listing.name(path)) for path in listing.pictures]
    small = [_find_board(frame, spec) for frame in frames]
    _refuse_same_files(frames)
    _refuse_drawn(frames, small)
    # One camera's pictures have one size: that of most with a board. Of two that are as frequent the larger: pictures
    # whose lens somebody took out are cropped.
    sizes = Counter(f.view.size for f in frames if f.view is not None)
    usual = max(sizes, key=lambda size: (sizes[size], size[0] * size[1]), default=(0, 0))
    for frame in used(frames):
        if frame.view is not None and frame.view.size != usual:
            size, expected = (f"{width}×{height}" for width, height in (frame.view.size, usual))
            frame.refuse(Reason.WRONG_SIZE, f"the picture is {size} px, expected {expected} like the others")
    channel = _read_stripes(frames, _find_places(frames, links), laser)
    for frame in frames:
        # The same file as a copy shows what that copies.
        while frame.shows is not None and frame.shows.shows is not None:
            frame.shows = frame.shows.shows
    return frames, channel


def _find_board(frame: RecordedFrame, spec: BoardSpec) -> Small | None:
    """Find the board in a frame's picture, or refuse it; a small copy (n,) of the picture that was read."""
    small = None
    try:
        image = read_picture(frame.path)
        small = cv2.resize(image, SMALL, interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
        frame.view = find_board(image, spec)
    except PictureRefused as refused:
        frame.refuse(refused.reason, str(refused))
    except (ArithmeticError, LookupError, ValueError, cv2.error) as error:
        # One picture that upsets the search must not end the reading of the others.
        frame.refuse(Reason.UNREADABLE, f"the search for the board failed: {type(error).__name__}: {error}")
    return small


def _refuse_same_files(frames: Sequence[RecordedFrame]) -> None:
    """Refuse copies of a file; of pictures without a board, all dark for example, those of other frames may be same."""
    seen: dict[str, RecordedFrame] = {}
    for frame in frames:
        if frame.reason not in (Reason.UNREADABLE, Reason.CUT):
            digest = "" if frame.view is not None else frame_key(frame.name)
            digest += hashlib.sha1(frame.path.read_bytes(), usedforsecurity=False).hexdigest()
            first = seen.setdefault(digest, frame)
            if first is not frame:
                frame.shows = first
                frame.refuse(Reason.DUPLICATE, f"the same file as {first.name}")


def _refuse_drawn(frames: Sequence[RecordedFrame], small: Sequence[Small | None]) -> None:
    """Refuse frames that are others with something drawn in, or straightened; `small` copies (n,) by frame.

    Corners, axes and markers are found by their pixels. A straightened copy differs everywhere a little: there its name
    has to say it, too.
    """
    coloured = cache(_has_colour)
    for frame, mine in zip(frames, small, strict=True):
        for other, its in zip(frames, small, strict=True):
            if other is frame or mine is None or its is None or frame.reason is Reason.DUPLICATE or other.shows:
                continue
            if np.abs(mine - its).mean() > ALIKE_DN:
                continue
            if STRAIGHTENED.search(frame.name) and not STRAIGHTENED.search(other.name):
                text = f"by its name it is {other.name}, straightened"
            elif not frame.lit and coloured(frame.path) and _drawn_into(frame, other):
                text = f"it is {other.name} with lines drawn into it"
            else:
                continue
            frame.shows = other
            frame.refuse(Reason.DUPLICATE, text)


def _has_colour(path: Path) -> bool:
    """True where lines in pure colours may be in the picture."""
    try:
        image = read_colours(path)
    except PictureRefused:
        return False
    return image.ndim == 3 and bool((_spread(_coloured(image)) > COLOURED_DN).any())


def _spread(image: NDArray[np.uint8]) -> NDArray[np.int16]:
    """How far the colours (h, w, 3) of a pixel are apart, in DN."""
    red, green, blue = cv2.split(image)
    wide = cv2.subtract(cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue))
    return np.asarray(wide, dtype=np.int16)


def _drawn_into(frame: RecordedFrame, other: RecordedFrame) -> bool:
    """True where a frame's picture is the other's with thin coloured lines over it."""
    try:
        drawn, plain = (_coloured(read_colours(f.path)) for f in (frame, other))
    except PictureRefused:
        return False
    if drawn.shape != plain.shape:
        return False
    apart = np.asarray(cv2.absdiff(drawn, plain)).max(axis=2)
    changed = apart > CHANGED_DN
    lines = changed & (_spread(drawn) - _spread(plain) > COLOURED_DN)
    few = 0 < changed.mean() < LARGEST_SHARE and np.median(apart) <= SAME_DN
    thick = cv2.erode(changed.astype(np.uint8), np.ones((max(5, drawn.shape[1] // THICK),) * 2, np.uint8))
    if not few or lines.sum() < COLOURED_SHARE * changed.sum() or thick.sum() > 0.1 * changed.sum():
        return False
    hue = cv2.cvtColor(drawn, cv2.COLOR_RGB2HSV)[:, :, 0][lines]
    # Hues count to 180; each primary in the middle of its part.
    parts = np.bincount((hue.astype(int) + 90 // HUES) % 180 * HUES // 180, minlength=HUES)
    several, view = bool((parts > HUE_SHARE * len(hue)).sum() > 1), frame.view or other.view
    if several or view is None:
        return several
    near = cv2.dilate(lines.astype(np.uint8), np.ones((2 * NEAR_PX + 1,) * 2, np.uint8))
    at = np.clip(np.round(view.pixels).astype(int), 0, np.array(view.size) - 1)
    return float(near[at[:, 1], at[:, 0]].mean()) > AT_POINTS


def _coloured(image: NDArray[np.uint8] | NDArray[np.uint16]) -> NDArray[np.uint8]:
    """A picture (h, w, 3) of 8 bits, red first."""
    if image.dtype == np.uint16:
        image = (image * np.float32(255 / range_of(image))).astype(np.uint8)
    eight = np.asarray(image, dtype=np.uint8)
    return np.repeat(eight[:, :, None], 3, axis=2) if eight.ndim == 2 else np.ascontiguousarray(eight[:, :, :3])


@dataclass(frozen=True)
class _Place:
    """The picture that shows the `board`, with its view, and the `others` of the same place."""

    board: RecordedFrame
    view: BoardView
    others: list[RecordedFrame]

    @property
    def dark(self) -> list[Path]:
        """Pictures without the laser, by their names."""
        return [f.path for f in self.others if f.dark]

    def sources(self) -> list[tuple[RecordedFrame, Source]]:
        """Where the stripe may be, each with the picture without the laser that takes most of the board away."""
        lit = [f for f in self.others if f.lit] or [f for f in self.others if not f.dark]
        offs = [*self.dark, self.board.path]
        return [(f, Source(f.path, self.view, calmest(f.path, offs, self.view))) for f in lit]


def _find_places(frames: Sequence[RecordedFrame], links: Sequence[dict[str, str]]) -> list[_Place]:
    """Places of which there are several pictures: named alike, named together by a table, or that show the same."""
    out = (Reason.DUPLICATE, Reason.UNREADABLE, Reason.CUT, Reason.WRONG_SIZE)
    usable = [f for f in frames if f.reason not in out and (f.view is None or f.reason is None)]
    first: dict[str, int] = {}
    for k, frame in enumerate(frames):
        first.setdefault(frame_key(frame.name), k)

    def order(frame: RecordedFrame) -> tuple[bool, bool, int, int, int]:
        """The board's picture is not named after the laser, of the first number, with the shortest name. Of a picture
        in two formats the larger file lost less."""
        return frame.lit, frame.dark, first[frame_key(frame.name)], len(frame.name), -frame.path.stat().st_size

    places = []
    for group in _together(usable, links):
        seen = [(f, f.view) for f in group if f.view is not None]
        count = len(seen)
        while seen:
            board, view = min(seen, key=lambda one: order(one[0]))
            near = [f for f, its in seen if _apart(view, its) <= SAME_PLACE_PX]
            # A picture without the board belongs to the place of its name, if there is one.
            others = [f for f in near if f is not board]
            others += [f for f in group if f.view is None] if len(near) == count else []
            if others:
                places.append(_Place(board, view, others))
            seen = [one for one in seen if one[0] not in near]
    return places


def _together(frames: Sequence[RecordedFrame], links: Sequence[dict[str, str]]) -> list[list[RecordedFrame]]:
    """Frames by what joins them, names, links or views; those that nothing joins to another are left out."""
    pairs = np.array([*_joined_by_name(frames, links), *_joined_by_view(frames)], dtype=int).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(frames),) * 2)
    labels = connected_components(graph, directed=False)[1].tolist() if frames else []
    groups = [[f for f, own in zip(frames, labels, strict=True) if own == label] for label in dict.fromkeys(labels)]
    return [group for group in groups if len(group) > 1]


def _joined_by_name(frames: Sequence[RecordedFrame], links: Sequence[dict[str, str]]) -> Iterator[tuple[int, int]]:
    """Pairs of indices of frames that are named alike, or that a table names together."""
    first: dict[str, int] = {}
    for k, frame in enumerate(frames):
        if key := frame_key(frame.name):
            yield first.setdefault(key, k), k
    index = {f.name: k for k, f in enumerate(frames)}
    for link in links:
        linked = [index[v] for v in link.values() if v in index]
        yield from ((linked[0], k) for k in linked[1:])


def _joined_by_view(frames: Sequence[RecordedFrame]) -> Iterator[tuple[int, int]]:
    """Pairs of indices of frames that show the board at the same pixels."""
    seen = [(k, v, np.median(v.pixels, axis=0)) for k, f in enumerate(frames) if (v := f.view) is not None]
    for i, (k, view, middle) in enumerate(seen):
        for j, other, its in seen[:i]:
            if np.abs(middle - its).max() < FAR_PX and _apart(other, view) < SAME_VIEW_PX:
                yield j, k


def _apart(a: BoardView, b: BoardView) -> float:
    """Median distance in px of the same points of two views, in any order that the board allows. Infinite for other
    sizes, and where few points are seen in both."""
    found = [_paired(a, turned) for turned in b.turns() if a.size == b.size]
    return min((float(np.median(off)) for off in found if off is not None), default=float("inf"))


def _paired(a: BoardView, b: BoardView) -> NDArray[np.float64] | None:
    """Distances in px of the points that two views share; None where these are few."""
    _, here, there = np.intersect1d(a.ids, b.ids, return_indices=True)
    few = len(here) < LEAST_SHARED * max(len(a.ids), len(b.ids))
    return None if few else np.linalg.norm(a.pixels[here] - b.pixels[there], axis=1)


def _read_stripes(
    frames: Sequence[RecordedFrame], places: Sequence[_Place], laser: LaserChannel | None
) -> ChosenChannel:
    """Read the stripe of each board in its own picture or in another of its place, and set the others aside."""
    sources = [place.sources() for place in places]
    boards = {id(f) for place in places for f in (place.board, *place.others)}
    own = [(f, Source(f.path, f.view)) for f in used(frames) if f.view is not None]
    alone = [source for f, source in own if id(f) not in boards]
    channel = choose_channel([source for some in sources for _, source in some] + alone, laser)
    for place, some in zip(places, sources, strict=True):
        _read_place(place, some, channel)
    for frame, source in own:
        if frame.reason is None and frame.profile is None:
            frame.take(read_on_board(source, channel))
    return channel


def _read_place(place: _Place, sources: Sequence[tuple[RecordedFrame, Source]], channel: ChosenChannel) -> None:
    """The stripe of a place, from the picture that is named after the laser or shows it."""
    board = place.board
    reads = [(frame, source, read_on_board(source, channel)) for frame, source in sources]
    lit = max((r for r in reads if r[2].profile is not None), key=lambda r: r[2].points, default=None)
    if lit is None or not lit[0].lit:
        mine = read_on_board(Source(board.path, place.view, next(iter(place.dark), None)), channel)
        if mine.profile is not None:
            board.take(mine)
            lit = None
    if lit is not None:
        frame, source, read = lit
        board.take(read)
        board.stripe_from = frame.name
        frame.refuse(Reason.LASER_PICTURE, f"the laser's picture of {board.name}")
        off = next((f for f in (board, *place.others) if read.off and f.path == source.off), None)
        board.stripe_off = off.name if off is not None else ""
        if off is not None and off is not board:
            off.refuse(Reason.LASER_PICTURE, f"the picture without the laser of {board.name}")
    for frame in place.others:
        frame.shows = board
        if frame.reason is None:
            frame.refuse(Reason.DUPLICATE, f"it shows what {board.name} shows")


# Pictures of one stop of the arm are one measurement: they share the arm's error, the board's place and its print.
# Counted as several they would seem to check each other, and the deviations that come from leaving one out would mean
# nothing. So each stop becomes one frame: the mean of its points and of its poses.
Item = TypeVar("Item")


def grouped(items: Sequence[Item], same: Callable[[Item, Item], bool]) -> list[list[Item]]:
    """Items that are the same as the first of a group, in the order of these first."""
    groups: list[list[Item]] = []
    for item in items:
        group = next((g for g in groups if same(g[0], item)), None)
        if group is None:
            groups.append([item])
        else:
            group.append(item)
    return groups


def by_stop(frames: Sequence[RecordedFrame]) -> list[list[RecordedFrame]]:
    """The frames with a view, those of one stop together, in the order of their first."""

    def same(a: RecordedFrame, b: RecordedFrame) -> bool:
        if a.view is None or b.view is None or _like(a.view, b.view) is None:
            return False
        if a.base_from_flange is None or b.base_from_flange is None:
            return a.base_from_flange is b.base_from_flange
        return near(a.base_from_flange, b.base_from_flange)

    return grouped(frames, same)


def merged(stop: Sequence[RecordedFrame]) -> RecordedFrame:
    """One frame for a stop, named like its first: mean points and pose, the stripe that covers most rows. The points' σ
    stays that of one picture: what is wrong with a corner at a place is wrong in every picture of it."""
    first = stop[0]
    if len(stop) == 1 or first.view is None:
        return first
    views = [view for f in stop if f.view is not None and (view := _like(first.view, f.view)) is not None]
    ids = np.unique(np.concatenate([v.ids for v in views]))
    count, sigma, pixels = np.zeros(len(ids)), np.zeros(len(ids)), np.zeros((len(ids), 2))
    for view in views:
        at = np.searchsorted(ids, view.ids)
        count[at] += 1
        sigma[at] += view.sigma
        pixels[at] += view.pixels
    whole = replace(first.view, ids=ids, pixels=pixels / count[:, None], sigma=sigma / count)
    poses = [f.base_from_flange for f in stop if f.base_from_flange is not None]
    stripe = max((f.profile for f in stop if f.profile is not None), key=lambda p: len(p.rows), default=None)
    return RecordedFrame(first.path, first.name, whole, stripe, mean(poses) if poses else None)


def counted(pictures: int, stops: int, what: str = "pictures") -> str:
    """How many there are, for people: `12 pictures of 4 stops`, or `4 frames` where each is a stop of its own."""
    return f"{stops} frames" if pictures == stops else f"{pictures} {what} of {stops} stops"


def near(a: pin.SE3, b: pin.SE3, metres: float = SAME_M, turn: float = SAME_RAD) -> bool:
    """True for poses that are one: no further apart than so many m and rad."""
    apart = difference(a, b)
    return bool(np.linalg.norm(apart[:3]) <= metres and np.linalg.norm(apart[3:]) <= turn)


def _like(first: BoardView, other: BoardView) -> BoardView | None:
    """The other view in the order that puts its points where the first has them; None where none does."""
    for view in other.turns():
        off = _paired(first, view)
        if off is not None and np.sqrt(np.mean(off**2)) <= SAME_PX:
            return view
    return None

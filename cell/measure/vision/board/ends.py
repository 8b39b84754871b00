"""Whether the board in the picture ends where the named board does: a larger or smaller one must not pass for it.

Each side is looked at one pitch beyond the outermost points. A board without marks must be seen to end on every side.
"""

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.lattice import PlaneMap
from cell.measure.vision.board.view import BoardSpec
from cell.measure.vision.pictures import Image, PictureRefused, Reason


class OtherBoard(PictureRefused):
    """A board that was identified, and does not end where the named one does."""


# Share of the places along a side that have to show its end, and how many further points contradict it.
LEAST_ENDS = 0.3
MOST_BEYOND = 2
# What is brighter than this share of the step from black to white beside it is the sheet, not a cover.
AS_WHITE = 0.85
# Where a chessboard's end is looked for, in pitches beyond the outermost corners: the first place lies in a square
# that may be only half as wide as the others. Over so many places the two columns are alike only beyond the squares.
# A margin is darker than the white by at most this share of the contrast.
OUTWARD = np.array([0.25, *np.arange(0.45, 1.5, 0.05)])
FLAT = 5
MARGIN_SHORT = 0.25


def check_dot_ends(image: Image, spec: BoardSpec, plane: PlaneMap, found: NDArray[np.intp], radius: float) -> None:
    """Refuse unless the dots `found` (ids) reach the board's edges and no dot follows; `radius` in pitches. A marked
    board's order comes from its rings: for it, only what contradicts is refused."""
    smooth = smoothed(image)
    lattice = spec.lattice()
    marked = spec.kind == "marked_dots"
    around = 1.65 * radius * np.column_stack([f(np.arange(8) * np.pi / 4) for f in (np.cos, np.sin)])
    own = lattice[found]
    level = typical(grey(smooth, plane.pixels(own)))
    sides = next_places(spec)
    which = np.repeat(np.arange(len(sides)), [len(beyond) for _, beyond in sides])
    spots, outward, near = _spots(own, np.concatenate([beyond for _, beyond in sides]), around, radius)
    there = grey(smooth, plane.pixels(spots.reshape(-1, 2))).reshape(spots.shape[:2])
    dark, between, middle, near_side = there[:, :4].T
    rim, step = there[:, 4:], between - dark
    seen = step > np.maximum(4.0, 0.12 * (between - level))
    darker = rim - middle[:, None] > 0.4 * step[:, None]
    beside = np.argsort(np.abs(outward @ around.T), axis=1)[:, :2]
    goes_on = seen & darker.all(axis=1)
    # A line round the board goes on to both sides, which no dot does.
    bare = ~np.take_along_axis(darker, beside, axis=1).any(axis=1)
    bare &= np.isfinite(np.take_along_axis(rim, beside, axis=1)).all(axis=1)
    bare |= (near_side - dark > 0.6 * step) | (np.isfinite(rim).all(axis=1) & (darker.sum(axis=1) < 6))
    for k, (name, _) in enumerate(sides):
        here = which[near] == k
        further, ends = int((here & goes_on).sum()), int((here & seen & ~goes_on & bare).sum())
        if further >= MOST_BEYOND:
            raise OtherBoard(
                Reason.NO_BOARD,
                f"the board in the picture goes on beyond the {name} of {spec.name}: {further} more dots there; "
                "is it the board that the set-up names?",
            )
        if not marked and ends < max(1.0, LEAST_ENDS * (here & seen).sum()):
            raise PictureRefused(
                Reason.AMBIGUOUS,
                f"the end of the board beyond the {name} of {spec.name} is not seen; show the whole board",
            )
    if marked:
        check_hidden_sides(smooth, spec, plane, found, 0.5)


def _spots(
    own: NDArray[np.intp], beyond: Array, around: Array, radius: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Where one looks for the end of a side: spots (n, 12, 2) for n of the m places `beyond`, the ways out (n, 2), and
    which places (m,) these are: those far from every dot are left out.

    Spots are the nearest of the board's `own` dots, half way to the place, the place, its near side, and what lies
    `around` it.
    """
    nearest = own[np.abs(own[None] - beyond[:, None]).sum(axis=2).argmin(axis=1)].astype(np.float64)
    near = np.abs(nearest - beyond).max(axis=1) <= 2
    place, dot = beyond[near], nearest[near]
    out = (place - dot) / np.linalg.norm(place - dot, axis=1, keepdims=True)
    # The near side of the dot that would follow is seen even where the picture or a narrow sheet ends.
    along = np.stack([dot, 0.5 * (dot + place), place, place - 0.75 * radius * out], axis=1)
    return np.concatenate([along, place[:, None] + around], axis=1), out, near


def typical(values: Array) -> float:
    """Median of the values that are numbers; 0 when none is."""
    numbers = values[np.isfinite(values)]
    return float(np.median(numbers)) if len(numbers) else 0.0


def smoothed(image: Image) -> Image:
    """The picture (h, w) with its noise averaged over three pixels."""
    return np.asarray(cv2.GaussianBlur(image, (3, 3), 0), dtype=np.uint8)


def check_hidden_sides(smooth: Image, spec: BoardSpec, plane: PlaneMap, found: NDArray[np.intp], beyond: float) -> None:
    """Refuse a smaller board: a whole side without a point, though the bright sheet is seen before it.

    `smooth` is the picture without its noise (`smoothed`); `beyond` is where, in pitches beyond the last points found,
    only the sheet's margin can be bright all along.
    """
    cols, rows = spec.grid
    own = spec.lattice()[found]
    # Both colours are met around any point: of a ChArUco board between corner and marker.
    around = np.array([[0.0, 0.0], [0.5, 0.5], [-0.5, 0.5], [0.1, 0.1], [-0.1, 0.1]])
    levels = grey(smooth, plane.pixels((own[:, None, :] + around).reshape(-1, 2))).reshape(len(own), -1)
    black, white = np.nanmin(levels, axis=1), np.nanmax(levels, axis=1)
    for name, axis, sign, last in (
        ("first row", 1, -1, 0),
        ("last row", 1, 1, rows - 1),
        ("first column", 0, -1, 0),
        ("last column", 0, 1, cols - 1),
    ):
        reached = int((sign * own[:, axis]).max()) * sign
        if reached == last:
            continue
        at_line = own[:, axis] == reached
        line = own[at_line].astype(np.float64)
        outward = np.zeros(2)
        outward[axis] = sign
        there = grey(smooth, plane.pixels(np.vstack([line + beyond * outward, line + 1.5 * outward])))
        # A point beyond is measured only where the picture holds all of it.
        margin, behind = there[: len(line)], there[len(line) :]
        seen = np.isfinite(margin) & np.isfinite(behind)
        bright = (margin > black[at_line] + AS_WHITE * (white - black)[at_line])[seen]
        if seen.sum() >= 2 and bright.mean() > 0.6:
            raise OtherBoard(
                Reason.NO_BOARD,
                f"the board in the picture ends before the {name} of {spec.name}, which is not hidden; is it the board "
                "that the set-up names?",
            )


def check_chess_ends(image: Image, spec: BoardSpec, plane: PlaneMap) -> None:
    """Refuse unless the pattern of squares stops one square beyond the outermost corners, on every side. The outermost
    squares may be narrower than the others, and the white margin beyond them as narrow as it likes."""
    smooth = np.asarray(cv2.GaussianBlur(image, (5, 5), 0), dtype=np.uint8)
    cols, rows = spec.grid
    for name, start, along, out, count in (
        ("first row", (0, 0), (1, 0), (0, -1), cols),
        ("last row", (0, rows - 1), (1, 0), (0, 1), cols),
        ("first column", (0, 0), (0, 1), (-1, 0), rows),
        ("last column", (cols - 1, 0), (0, 1), (1, 0), rows),
    ):
        k = np.arange(count + 1)[:, None] - 0.5
        line = np.array(start) + k * np.array(along)
        places = (line + OUTWARD[:, None, None] * np.array(out)).reshape(-1, 2)
        at = grey(smooth, plane.pixels(places)).reshape(len(OUTWARD), -1)
        inner, differences = at[0], np.diff(at, axis=1)
        difference = differences[0]
        # Not a number where the line lies outside the picture: there no end is seen.
        seen = np.abs(difference) > max(3.0, 0.4 * typical(np.abs(difference)))
        seen[1:] &= np.sign(difference[1:]) != np.sign(difference[:-1])
        # 1 where the last squares are, −1 where squares follow, 0 where neither column is told from the other.
        share = differences / np.where(difference == 0, 1.0, difference)
        # Beyond the last square both a black and a white one are followed by white. Where the squares go on never.
        white = np.maximum(inner[1:], inner[:-1]) - MARGIN_SHORT * np.abs(difference)
        margin = (np.minimum(at[1:, 1:], at[1:, :-1]) > white).any(axis=0)
        same = sliding_window_view(np.abs(share) < 0.3, FLAT, axis=0).all(axis=-1).any(axis=0)
        follows = (share[(OUTWARD > 0.72) & (OUTWARD < 0.88)] > 0.5).all(axis=0)
        follows &= (share[(OUTWARD > 1.18)] < -0.5).all(axis=0)
        goes_on = int((seen & ~margin & ~same & follows).sum())
        ends = int((seen & (margin | same)).sum())
        if goes_on > max(1, ends):
            raise PictureRefused(
                Reason.NO_BOARD,
                f"the squares go on beyond the {name} of {spec.name}; is it the board that the set-up names?",
            )
        if ends < max(1.0, LEAST_ENDS * seen.sum()):
            raise PictureRefused(
                Reason.AMBIGUOUS,
                f"the end of the board beyond the {name} of {spec.name} is not seen; show the whole board with its "
                "margin",
            )


def grey(image: Image, pixels: Array) -> Array:
    """Grey values (n,) at pixels (n, 2), NaN outside of the picture."""
    if not len(pixels):
        return np.zeros(0)
    height, width = image.shape
    at = pixels.astype(np.float32).reshape(-1, 1, 2)
    values = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (pixels > 0).all(axis=1) & (pixels < (width - 1, height - 1)).all(axis=1)
    return np.asarray(np.where(inside, values.ravel().astype(np.float64), np.nan), dtype=np.float64)


def next_places(spec: BoardSpec) -> list[tuple[str, Array]]:
    """For each side of a board: its name and the places (n, 2) of the points that would come next."""
    cols, rows = spec.grid
    i, j = np.arange(cols), np.arange(rows)

    def place(a: NDArray[np.intp] | int, b: NDArray[np.intp] | int) -> Array:
        x, y = np.broadcast_arrays(a, b)
        across = 2 * x + y % 2 if spec.kind == "asymmetric_dots" else x
        return np.column_stack([across, y]).astype(np.float64)

    return [
        ("first row", place(i, -1)), ("last row", place(i, rows)), ("first column", place(-1, j)),
        ("last column", place(cols, j)),
    ]  # fmt: skip

"""Chessboards in a picture: crossings, their lattice, its outline and colours, then every corner that must be there.

Corners come in one order: x along the columns, y down the rows, z into the board, the first square black.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.corners import fit_corners
from cell.measure.vision.board.ends import check_chess_ends, grey, next_places
from cell.measure.vision.board.lattice import Places, PlaneMap, Seeds, by_outline, lattices
from cell.measure.vision.board.view import BoardSpec, BoardView
from cell.measure.vision.pictures import Image, PictureRefused, Reason, only_one

LEAST_CORNERS = 6
LEAST_SHARE = 0.5
LEAST_SIGMA_PX = 0.0025
LEAST_COLOURS = 0.85
# Of the places of a next row; clutter may look like a corner here and there.
MOST_BEYOND = 0.4
# The picture is searched at half its size first, where noise and blur are less.
SCALES = (0.5, 1.0, 0.25)
# A laser line is thinner than this and longer than this share of the picture.
STREAK_PX = 31
STREAK_SHARE = 0.15
# Crossings: a ring of samples around each, how alike it is to itself turned by half a turn, and its contrast.
SAMPLES = 32
RADII = (4.5, 7.0)
MOST = 1200
LEAST_ANTIPODAL = 0.55
LEAST_SECOND = 0.5
LEAST_CONTRAST_DN = 5.0
SEEDS = 40


def find_chessboard(image: Image, spec: BoardSpec) -> BoardView:
    """The inner corners of a chessboard in an 8-bit image (h, w). Raises PictureRefused."""
    least = max(LEAST_CORNERS, int(0.3 * len(spec.lattice())))
    lit = laser_streaks(image)
    refusals: list[PictureRefused] = []
    for scale in SCALES:
        if scale * min(image.shape) < 100:
            continue
        corners = find_corners(image, scale)
        if lit.any():
            clear = ~_near(lit, corners.places, 2)
            corners = Corners(corners.places[clear], corners.dark[clear])
        views = []
        for index, places in corner_lattices(corners, least):
            try:
                views.append(_view(image, lit, spec, corners=corners, index=index, places=places))
            except PictureRefused as refused:
                refusals.append(refused)
        if views:
            return only_one(views, spec.name)
    if refusals:
        raise max(refusals, key=lambda r: r.reason is Reason.AMBIGUOUS)
    raise PictureRefused(
        Reason.NO_BOARD, f"no {spec.name} in the picture: show all of its squares with their white margin, in focus"
    )


def _view(
    image: Image, lit: Image, spec: BoardSpec, corners: "Corners", index: NDArray[np.intp], places: Places
) -> BoardView:
    index, places = _extended(corners, index, places, spec.name)
    pixels = corners.places[index]
    order = _by_colour(spec, by_outline(spec, places, LEAST_SHARE), pixels, corners.dark[index])
    known = (order >= 0).all(axis=1)
    plane = PlaneMap.fit(order[known], pixels[known], _tolerance(order[known], pixels[known]), spec.name)
    lattice = spec.lattice()
    flat = lattice.astype(np.float64)
    starts = plane.pixels(flat)
    # The cell between the corners (0, 0) and (1, 1) has the colour of the first square.
    dark_first = _colours(order[known], plane, corners.dark[index][known]) > 0
    even = order[known].sum(axis=1) % 2 == 0
    first_is_dark = bool((dark_first == even).mean() > 0.5)
    dark = np.asarray((lattice.sum(axis=1) % 2 == 0) == first_is_dark, dtype=np.bool_)
    measured, sigma, contrast = fit_corners(image, starts, plane.steps(flat), dark)
    good = np.isfinite(sigma)
    if lit.any():
        good &= ~_near(lit, starts, 5)
    if good.sum() < max(LEAST_CORNERS, LEAST_SHARE * len(lattice)):
        raise PictureRefused(
            Reason.NO_BOARD, f"only {good.sum()} of the {len(lattice)} corners of {spec.name} could be measured"
        )
    seen = PlaneMap.fit(flat[good], measured[good], 3.0, spec.name)
    _check_none_beyond(image, spec, seen, 0.4 * float(np.median(contrast[good])))
    check_chess_ends(image, spec, seen)
    ids = np.flatnonzero(good)
    size = (image.shape[1], image.shape[0])
    return BoardView(spec, size, ids, measured[ids], np.hypot(sigma[ids], LEAST_SIGMA_PX), order_assumed=spec.symmetric)


def _check_none_beyond(image: Image, spec: BoardSpec, plane: PlaneMap, contrast: float) -> None:
    """Refuse a larger board: one with crossings of at least `contrast` DN where the next row or column would be."""
    quarters = 0.25 * np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]])
    for name, places in next_places(spec):
        around = grey(image, plane.pixels((places[:, None, :] + quarters).reshape(-1, 2))).reshape(-1, 4)
        one, other = around[:, :2], around[:, 2:]
        step = np.maximum(one.min(axis=1) - other.max(axis=1), other.min(axis=1) - one.max(axis=1))
        there = int((step > contrast).sum())
        if there >= max(2, MOST_BEYOND * len(places)):
            raise PictureRefused(
                Reason.NO_BOARD,
                f"{there} more corners follow beyond the {name} of {spec.name}; is it the board that the set-up names?",
            )


def _extended(
    corners: "Corners", index: NDArray[np.intp], places: Places, name: str
) -> tuple[NDArray[np.intp], Places]:
    """The lattice with the corners beyond a gap, such as a cable, that fit it."""
    tree = scipy.spatial.cKDTree(corners.places)
    for _ in range(3):
        pixels = corners.places[index]
        plane = PlaneMap.fit(places, pixels, _tolerance(places, pixels), name)
        low, high = places.min(axis=0) - 2, places.max(axis=0) + 2
        grid = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
        held = {tuple(p) for p in places}
        open_places = np.array([p for p in grid if tuple(p) not in held]).reshape(-1, 2)
        flat = open_places.astype(np.float64)
        guess, steps = plane.pixels(flat), plane.steps(flat)
        distance, who = tree.query(guess)
        near = np.asarray(distance) < 0.2 * np.linalg.norm(steps, axis=1).min(axis=1)
        near &= ~np.isin(who, index)
        colours = _colours(places, plane, corners.dark[index])
        even = float(np.sign(np.median(colours * np.where(places.sum(axis=1) % 2 == 0, 1, -1)) or 1.0))
        own = _colours(open_places, plane, corners.dark[who])
        near &= own * np.where(open_places.sum(axis=1) % 2 == 0, 1, -1) * even > 0
        if not near.any():
            break
        index = np.concatenate([index, np.asarray(who)[near]])
        places = np.concatenate([places, open_places[near]])
        index, first = np.unique(index, return_index=True)
        places = places[first]
    return index, places


def _tolerance(places: Places, pixels: Array) -> float:
    """A quarter of a pitch in px: a lens bends a board by less than that between its corners."""
    fit = np.linalg.lstsq(np.column_stack([places, np.ones(len(places))]).astype(np.float64), pixels, rcond=None)[0]
    return max(2.0, 0.25 * float(np.sqrt(abs(np.linalg.det(fit[:2])))))


def _colours(places: Places, plane: PlaneMap, dark: Array) -> Array:
    """Positive (n,) where the square between +x and +y is dark; `dark` (n,) are directions of dark sectors."""
    steps = plane.steps(places.astype(np.float64))
    direction = np.column_stack([np.cos(dark), np.sin(dark)])
    local = np.linalg.solve(steps, direction[:, :, None])[:, :, 0]
    return np.asarray(local[:, 0] * local[:, 1], dtype=np.float64)


def _by_colour(spec: BoardSpec, orders: list[Places], pixels: Array, dark: Array) -> Places:
    """The order in which the first square is black; of a symmetric board that which begins at the upper left."""
    fitting = []
    for order in orders:
        known = (order >= 0).all(axis=1)
        plane = PlaneMap.fit(order[known], pixels[known], _tolerance(order[known], pixels[known]), spec.name)
        dark_first = _colours(order[known], plane, dark[known]) > 0
        share = float((dark_first == (order[known].sum(axis=1) % 2 == 0)).mean())
        fitting.append((share, float(plane.pixels(np.zeros((1, 2))).sum()), order))
    matching = [f for f in fitting if f[0] > LEAST_COLOURS]
    if spec.symmetric and not matching:
        matching = [f for f in fitting if f[0] < 1 - LEAST_COLOURS]
    if not 0 < len(matching) <= spec.orders:
        raise PictureRefused(
            Reason.AMBIGUOUS,
            f"the corners found fit {spec.name} in {len(matching)} ways, so their order is not certain; show the whole "
            "board",
        )
    return min(matching, key=lambda f: f[1])[2]


def laser_streaks(image: Image) -> Image:
    """Mask (h, w) of long thin saturated streaks: a laser line, not the white of an over-exposed board or marker."""
    white = (image >= 250).astype(np.uint8)
    mask = np.zeros_like(white)
    if not white.any():
        return mask
    wide = cv2.morphologyEx(white, cv2.MORPH_OPEN, np.ones((STREAK_PX, STREAK_PX), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(cv2.subtract(white, wide), connectivity=8)
    length = np.hypot(stats[:, 2], stats[:, 3])
    long = (length >= STREAK_SHARE * max(image.shape)) & (stats[:, 4] <= STREAK_PX * length)
    for label in np.flatnonzero(long[1:]) + 1:
        x, y, w, h, _ = stats[label]
        inside = labels[y : y + h, x : x + w] == label
        across = np.linalg.eigvalsh(np.cov(np.argwhere(inside).T.astype(np.float64)))[0]
        if across < (STREAK_PX / 3) ** 2:
            mask[y : y + h, x : x + w][inside] = 1
    return np.asarray(cv2.dilate(mask, np.ones((9, 9), np.uint8)), dtype=np.uint8)


def _near(lit: Image, corners: Array, reach: int) -> NDArray[np.bool_]:
    """Corners (n,) whose surroundings of ± reach px contain laser light."""
    wide = cv2.dilate(lit, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    x = np.round(corners[:, 0]).astype(int).clip(0, lit.shape[1] - 1)
    y = np.round(corners[:, 1]).astype(int).clip(0, lit.shape[0] - 1)
    return np.asarray(wide[y, x] > 0, dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class Corners:
    """Crossings of two edges: `places` (n, 2) in px and `dark` (n,), the direction in rad of a dark sector's middle."""

    places: Array
    dark: Array


def find_corners(image: Image, scale: float) -> Corners:
    """Saddles of an 8-bit image (h, w), looked for in the picture shrunk to `scale`."""
    small = image
    if scale < 1.0:
        small = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    smooth = np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.4), dtype=np.float32)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3, scale=0.25)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3, scale=0.25)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    saddle = xy * xy - xx * yy
    top = cv2.dilate(saddle, np.ones((7, 7), np.uint8))
    rows, columns = np.nonzero((saddle == top) & (saddle > 0.05))
    inside = (rows > 8) & (columns > 8) & (rows < saddle.shape[0] - 9) & (columns < saddle.shape[1] - 9)
    rows, columns = rows[inside], columns[inside]
    strongest = np.argsort(-saddle[rows, columns])[:MOST]
    rows, columns = rows[strongest], columns[strongest]
    # Newton's step to where the gradient vanishes.
    gx, gy = (cv2.Sobel(smooth, cv2.CV_32F, a, b, ksize=3, scale=0.125)[rows, columns] for a, b in ((1, 0), (0, 1)))
    determinant = np.minimum(-saddle[rows, columns], -1e-6)
    a, b, c = xx[rows, columns], xy[rows, columns], yy[rows, columns]
    move = np.column_stack([-(c * gx - b * gy) / determinant, -(a * gy - b * gx) / determinant])
    places = np.column_stack([columns, rows]) + np.clip(move, -1.5, 1.5)
    crossing, dark = _crossings(smooth, places)
    return Corners((places[crossing] + 0.5) / scale - 0.5, dark[crossing])


def _crossings(smooth: NDArray[np.float32], places: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which places (n, 2) look alike when turned by half a turn and change their sign four times around (n,)."""
    angles = np.arange(SAMPLES) * 2 * np.pi / SAMPLES
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    good = np.zeros(len(places), dtype=np.bool_)
    dark = np.zeros(len(places))
    if not len(places):
        return good, dark
    for radius in RADII:
        at = (places[:, None, :] + radius * unit).astype(np.float32)
        ring = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        ring = ring.reshape(len(places), SAMPLES).astype(np.float64)
        span = np.ptp(ring, axis=1)
        # The middle between bright and dark, not the mean: sectors seen obliquely are not equally wide.
        level = ring - 0.5 * (ring.max(axis=1) + ring.min(axis=1))[:, None]
        power = (level**2).sum(axis=1) + 1e-9
        antipodal = (level * np.roll(level, SAMPLES // 2, axis=1)).sum(axis=1) / power
        turns = (np.sign(level) != np.sign(np.roll(level, 1, axis=1))).sum(axis=1)
        second = (level - level.mean(axis=1)[:, None]) @ np.exp(2j * angles)
        share = 2 * np.abs(second) ** 2 / SAMPLES / ((level - level.mean(axis=1)[:, None]) ** 2).sum(axis=1).clip(1e-9)
        new = (antipodal > LEAST_ANTIPODAL) & (turns == 4) & (share > LEAST_SECOND) & (span > LEAST_CONTRAST_DN) & ~good
        dark[new] = 0.5 * np.angle(second[new]) + np.pi / 2
        good |= new
    return good, dark


def corner_lattices(corners: Corners, least: int) -> Iterator[tuple[NDArray[np.intp], Places]]:
    """Lattices of at least `least` corners, none sharing a corner: indices (m,) and places (m, 2). Neighbours have
    their dark sectors at right angles to each other. Places are right-handed as the picture is."""
    n = len(corners.places)
    if n < least:
        return
    tree = scipy.spatial.cKDTree(corners.places)
    distances, who = map(np.asarray, tree.query(corners.places, k=min(n, 13)))
    dark: list[float] = corners.dark.tolist()
    # Regular surroundings first: the corners whose fourth neighbour is not much farther than the first.
    order = np.argsort(distances[:, min(4, who.shape[1] - 1)] / np.maximum(distances[:, 1], 1e-9))

    def opposite(a: int, b: int) -> bool:
        return abs(math.sin(dark[a] - dark[b])) > 0.7

    seeds = Seeds(order, who, opposite, first_steps=4, least_sine=0.3, most=SEEDS)
    yield from lattices(corners.places, tree, seeds, least)

"""Boards of markers in a picture: ChArUco boards and grids of AprilTags. Which marker is which is read by OpenCV.

The markers say where every point must be, so a part of the board is enough; one that does not lie where the others put
it counts for nothing. A ChArUco board's points are its chessboard corners, a tag's the corners where the lines of its
four sides meet: corners of tags are rounded by blur, their sides are not.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.chess import LEAST_CORNERS, LEAST_SIGMA_PX
from cell.measure.vision.board.corners import fit_corners
from cell.measure.vision.board.ends import check_hidden_sides, smoothed
from cell.measure.vision.board.lattice import PlaneMap
from cell.measure.vision.board.view import BoardSpec, BoardView, propose_counts
from cell.measure.vision.pictures import Image, PictureRefused, Reason

LEAST_TAGS = 4
# A tag lies where the others put it to this share of its side, its corners as they are first read to that one.
TOLERANCE, ROUGH = 0.15, 0.3
# Each side is measured at so many places between these shares of its length, across ± this share of it.
PLACES = np.linspace(0.12, 0.88, 16)
ACROSS = 0.09
STEPS, LEVEL = 33, 6
LEAST_SIDE_SIGMA_PX = 0.01
SMALLEST_SIDE_PX = 12.0
LEAST_MARKERS = 3
# Markers that agree with one another but not with the board found, or that it does not have: a second board.
MOST_FOREIGN = 2
MARKER_TOLERANCE = 0.2
# Each kind of marker with its smaller sets first: a smaller one is the likelier name for what both can read.
DICTIONARIES = (
    *(f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)), "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10", "DICT_APRILTAG_36h11", "DICT_ARUCO_MIP_36h12",
)  # fmt: skip


def find_charuco(image: Image, spec: BoardSpec) -> BoardView:
    """The chessboard corners of a ChArUco board in an 8-bit image (h, w). Raises PictureRefused."""
    most = 0
    for picture in _variants(image):
        corners, ids = read_markers(picture, spec.dictionary)
        most = max(most, len(ids))
        if len(ids) < LEAST_MARKERS:
            continue
        layouts = (False, True) if spec.rows % 2 == 0 else (False,)
        solved = [s for legacy in layouts if (s := _solve(spec, corners, ids, legacy)) is not None]
        if not solved:
            continue
        plane, used, legacy = max(solved, key=lambda s: int(s[1].sum()))
        if used.sum() >= LEAST_MARKERS:
            _check_alone(spec, corners, ids, used, legacy)
            return _view(image, spec, plane, legacy)
    raise PictureRefused(
        Reason.NO_BOARD,
        f"{most} markers of {spec.name} were read, at least {LEAST_MARKERS} that fit together are needed: "
        + _why(image, spec, most),
    )


def _why(image: Image, spec: BoardSpec, most: int) -> str:
    """What else the picture shows: markers of another dictionary, or of another layout."""
    picture = next(_variants(image))
    if most >= LEAST_MARKERS:
        corners, ids = read_markers(picture, spec.dictionary)
        return (
            f"those read have ids up to {ids.max()} and do not lie as on this board; are its columns and rows right?"
            f"{propose_counts(spec, corners, ids)}"
        )
    best, name = best_dictionary(picture)
    if best >= LEAST_MARKERS:
        return f"there are {best} markers of {name}; name the board with :{name} at its end"
    return "no dictionary that is known has more of them; is the board in focus, and large enough in the picture?"


def best_dictionary(image: Image) -> tuple[int, str]:
    """The dictionary of which most markers can be read, of equals the smallest, and how many."""
    counts = [len(read_markers(image, name)[1]) for name in DICTIONARIES]
    best = max(counts)
    return best, DICTIONARIES[counts.index(best)]


def read_markers(image: Image, name: str, border: int = 1) -> tuple[Array, NDArray[np.intp]]:
    """Corners (n, 4, 2) in px and ids (n,) of the markers of a dictionary, whose black border is so many bits wide."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    if not len(corners):
        return np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp)
    return np.array(corners, dtype=np.float64).reshape(-1, 4, 2), np.asarray(ids, dtype=np.intp).ravel()


def _variants(image: Image) -> Iterator[Image]:
    """The picture stretched in contrast, evened out locally, and smoothed."""
    low, high = np.percentile(image[::4, ::4], (0.5, 97))
    span = max(float(high - low), 8.0)
    table = np.clip((np.arange(256) - low) * (235 / span) + 10, 0, 255).astype(np.uint8)
    stretched = np.asarray(cv2.LUT(image, table), dtype=np.uint8)
    yield stretched
    yield np.asarray(cv2.GaussianBlur(stretched, (0, 0), 1.5), dtype=np.uint8)
    yield np.asarray(cv2.createCLAHE(4.0, (8, 8)).apply(stretched), dtype=np.uint8)


def _layout_of(spec: BoardSpec, legacy: bool) -> Array:
    """Corners (n, 4, 2) of the markers in pitches from the first inner corner, in their reading order. The older layout
    of boards with an even number of rows begins with a marker, the present one with a black square."""
    j, i = np.divmod(np.arange(spec.cols * spec.rows), spec.cols)
    holds = (i + j) % 2 == (0 if legacy else 1)
    middle = np.column_stack([i[holds], j[holds]]) - 0.5
    half = 0.5 * spec.marker / spec.pitch
    return np.asarray(middle[:, None, :] + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), dtype=np.float64)


def _solve(
    spec: BoardSpec, corners: Array, ids: NDArray[np.intp], legacy: bool
) -> tuple[PlaneMap, NDArray[np.bool_], bool] | None:
    """The map of the board that most markers agree on, and which do (n,)."""
    layout = _layout_of(spec, legacy)
    own = ids < len(layout)
    if own.sum() < LEAST_MARKERS:
        return None
    places, pixels = layout[ids[own]].reshape(-1, 2), corners[own].reshape(-1, 2)
    side = float(np.median(np.linalg.norm(np.diff(corners[own], axis=1), axis=2))) * spec.pitch / spec.marker
    homography, inside = cv2.findHomography(places, pixels, cv2.RANSAC, max(2.0, MARKER_TOLERANCE * side))
    if homography is None or len(inside) == 0:
        return None
    whole = inside.reshape(-1, 4).all(axis=1)
    used = np.zeros(len(ids), dtype=np.bool_)
    used[np.flatnonzero(own)[whole]] = True
    if used.sum() < LEAST_MARKERS:
        return None
    plane = PlaneMap.fit(layout[ids[used]].reshape(-1, 2), corners[used].reshape(-1, 2), 10 * side, spec.name)
    if (np.linalg.det(plane.steps(np.array([spec.lattice().mean(axis=0)]))) <= 0).any():
        raise PictureRefused(Reason.MIRRORED, f"{spec.name} is seen mirrored: the picture is flipped")
    return plane, used, legacy


def _check_alone(spec: BoardSpec, corners: Array, ids: NDArray[np.intp], used: NDArray[np.bool_], legacy: bool) -> None:
    """Refuse two boards of these markers in view, and a board with more markers than the named one has."""
    foreign = int((ids >= spec.cols * spec.rows // 2).sum())
    if foreign >= MOST_FOREIGN:
        raise PictureRefused(
            Reason.NO_BOARD,
            f"{foreign} markers in the picture are none of {spec.name}, which has {spec.cols * spec.rows // 2}: is it "
            f"the board that the set-up names?{propose_counts(spec, corners, ids)}",
        )
    if (~used).sum() >= LEAST_MARKERS and _solve(spec, corners[~used], ids[~used], legacy) is not None:
        raise PictureRefused(
            Reason.AMBIGUOUS, f"two boards that could be {spec.name} are in view; cover or remove one of them"
        )


def _view(image: Image, spec: BoardSpec, plane: PlaneMap, legacy: bool) -> BoardView:
    lattice = spec.lattice()
    flat = lattice.astype(np.float64)
    dark = np.asarray((lattice.sum(axis=1) % 2 == 0) != legacy, dtype=np.bool_)
    # Up to the markers inside the white squares.
    share = 0.62 * (1 - spec.marker / spec.pitch)
    measured, sigma, _ = fit_corners(image, plane.pixels(flat), plane.steps(flat), dark, share)
    good = np.isfinite(sigma)
    if good.sum() >= LEAST_CORNERS:
        # Once more from the corners found: the markers bend a little less than the lens does.
        better = PlaneMap.fit(flat[good], measured[good], 3.0, spec.name)
        measured, sigma, _ = fit_corners(image, better.pixels(flat), better.steps(flat), dark, share)
        good = np.isfinite(sigma)
    if good.sum() < LEAST_CORNERS or np.linalg.matrix_rank(flat[good] - flat[good].mean(axis=0)) < 2:
        raise PictureRefused(
            Reason.NO_BOARD, f"{good.sum()} corners of {spec.name} could be measured; show more of it, in focus"
        )
    ids = np.flatnonzero(good)
    check_hidden_sides(smoothed(image), spec, plane, ids, 1.3)
    return BoardView(spec, (image.shape[1], image.shape[0]), ids, measured[ids], np.hypot(sigma[ids], LEAST_SIGMA_PX))


@dataclass(frozen=True, eq=False)
class _Layout:
    """Ids (n, 4) of the board's points that tags' corners are, where those are expected, and which tags lie so (n,)."""

    ids: NDArray[np.intp]
    corners: Array
    fits: NDArray[np.bool_]


def find_tags(image: Image, spec: BoardSpec) -> BoardView:
    """The tags' corners in an 8-bit image (h, w). Raises PictureRefused."""
    corners, tags = _read(image, spec)
    if spec.single:
        return _single(image, spec, corners)
    if len(tags) < LEAST_TAGS:
        raise PictureRefused(Reason.NO_BOARD, f"{len(tags)} tags of {spec.name} were read, {_instead(image, spec)}")
    if len(set(tags.tolist())) < len(tags):
        raise PictureRefused(
            Reason.AMBIGUOUS, f"two grids that could be {spec.name} are in view; cover or remove one of them"
        )
    if any(len(set(line.tolist())) == 1 for line in np.divmod(tags, spec.cols)):
        raise PictureRefused(
            Reason.NO_BOARD,
            f"the {len(tags)} tags of {spec.name} that were read lie on one line, from which no pose can be told; show "
            "tags of two rows and two columns",
        )
    layout = max(
        (_layout(spec, corners, tags, up, turn) for up in (0, 1) for turn in range(4)), key=lambda x: x.fits.sum()
    )
    if layout.fits.sum() < max(LEAST_TAGS, 0.7 * len(tags)):
        raise PictureRefused(
            Reason.NO_BOARD,
            f"{len(tags)} tags with ids {tags.min()} to {tags.max()} were read, but they do not lie as on {spec.name}: "
            "are its columns, rows, pitch and tag size right, and is its first tag number 0?",
        )
    measured, sigma = _by_sides(image, layout.corners[layout.fits])
    good = np.isfinite(sigma)
    if good.sum() < 4 * LEAST_TAGS:
        raise PictureRefused(
            Reason.NO_BOARD,
            f"the sides of {good.sum() // 4} tags of {spec.name} could be measured; go nearer, in focus",
        )
    ids = layout.ids[layout.fits].ravel()[good]
    order = np.argsort(ids)
    size = (image.shape[1], image.shape[0])
    return BoardView(spec, size, ids[order], measured[good][order], sigma[good][order])


def _single(image: Image, spec: BoardSpec, corners: Array) -> BoardView:
    """The corners of the one tag in view. Raises PictureRefused for none, and for several."""
    if len(corners) != 1:
        raise PictureRefused(
            Reason.AMBIGUOUS if len(corners) else Reason.NO_BOARD,
            f"{len(corners)} tags of {spec.dictionary} were read, {spec.name} is one: show it alone, in focus; several "
            "that are fixed to each other are an aprilgrid",
        )
    measured, sigma = _by_sides(image, corners)
    if not np.isfinite(sigma).all():
        raise PictureRefused(Reason.NO_BOARD, f"not all sides of {spec.name} could be measured; go nearer, in focus")
    return BoardView(spec, (image.shape[1], image.shape[0]), np.arange(4), measured, sigma)


def _read(image: Image, spec: BoardSpec) -> tuple[Array, NDArray[np.intp]]:
    """Corners (n, 4, 2) in px and ids (n,) of the tags, with a black border of one bit or of two."""
    best = max((read_markers(image, spec.dictionary, border) for border in (1, 2)), key=lambda found: len(found[1]))
    own = np.full(len(best[1]), spec.single) | (best[1] < spec.cols * spec.rows)
    if (~own).sum() >= 2:
        raise PictureRefused(
            Reason.NO_BOARD,
            f"tags with ids up to {best[1].max()} are in the picture, {spec.name} has {spec.cols * spec.rows}: is it "
            f"the board that the set-up names?{propose_counts(spec, *best)}",
        )
    return best[0][own], best[1][own]


def _instead(image: Image, spec: BoardSpec) -> str:
    best, name = best_dictionary(image)
    if best >= LEAST_TAGS and name.lower() != spec.dictionary.lower():
        return f"but {best} markers of {name}; name the board with :{name} at its end"
    return f"at least {LEAST_TAGS} are needed: is the whole grid in the picture, in focus?"


def _layout(spec: BoardSpec, corners: Array, tags: NDArray[np.intp], up: int, turn: int) -> _Layout:
    """Points of tags that are numbered from the last row upwards (`up`) or downwards, read from another corner. Squares
    that touch a tag's corners draw the corners first read inwards: the tags' middles count."""
    row, column = np.divmod(tags, spec.cols)
    place = (spec.rows - 1 - row if up else row) * spec.cols + column
    ids = (4 * place[:, None] + (np.arange(4) + turn) % 4).astype(np.intp)
    flat = spec.points()[ids, :2] / spec.pitch
    side = float(np.median(np.linalg.norm(np.diff(corners, axis=1), axis=2)))
    middles, pixels = flat.mean(axis=1), corners.mean(axis=1)
    homography, _ = cv2.findHomography(middles, pixels, cv2.RANSAC, max(2.0, TOLERANCE * side))
    if homography is None:
        return _Layout(ids, corners, np.zeros(len(tags), dtype=np.bool_))
    off = pixels - cv2.perspectiveTransform(middles[None], homography)[0]
    expected = cv2.perspectiveTransform(flat.reshape(1, -1, 2), homography).reshape(-1, 4, 2) + off[:, None]
    fits = np.linalg.norm(off, axis=1) < max(2.0, TOLERANCE * side)
    fits &= (np.linalg.norm(expected - corners, axis=2) < ROUGH * side).all(axis=1)
    return _Layout(ids, expected, np.asarray(fits, dtype=np.bool_))


def _by_sides(image: Image, corners: Array) -> tuple[Array, Array]:
    """Corners (4n, 2) where the lines of neighbouring sides of tags (n, 4, 2) meet, and σ (4n,), NaN if unseen."""
    begin, end = corners, np.roll(corners, -1, axis=1)
    along = end - begin
    length = np.linalg.norm(along, axis=2)
    unit = along / length[..., None]
    normal = np.stack([unit[..., 1], -unit[..., 0]], axis=-1)
    offsets = np.linspace(-1, 1, STEPS) * np.maximum(2.5, ACROSS * length)[..., None]
    middle = begin[:, :, None, :] + PLACES[:, None] * along[:, :, None, :]
    at = middle[:, :, :, None, :] + offsets[:, :, None, :, None] * normal[:, :, None, None, :]
    flat = at.reshape(-1, STEPS, 2).astype(np.float32)
    # A picture is read in strips of at most so many rows of a map.
    strips = [
        cv2.remap(image, s[..., 0], s[..., 1], cv2.INTER_LINEAR) for s in np.array_split(flat, len(flat) // 30000 + 1)
    ]
    grey = np.concatenate(strips).reshape(at.shape[:-1]).astype(np.float64)
    # Black lies inside. How much of the way is dark tells where the edge is, and averages what is printed on it.
    dark, bright = (np.median(grey[..., end], axis=-1) for end in (slice(None, LEVEL), slice(-LEVEL, None)))
    step = bright - dark
    share = np.clip((bright[..., None] - grey) / np.maximum(step, 1e-9)[..., None], 0.0, 1.0)
    reach = np.maximum(2.5, ACROSS * length)[..., None]
    off = reach * (2 * (share.sum(axis=-1) - 0.5) / (STEPS - 1) - 1)
    seen = step > 0.4 * np.median(step) + 3
    lines, spread = _lines(np.where(seen, off, np.nan), length)
    return _meetings(begin, normal, unit, lines=lines, spread=spread, length=length)


def _lines(off: Array, length: Array) -> tuple[Array, Array]:
    """Offset and slope (n, 4, 2) of each side's line over its length, and the RMS (n, 4) of its places in px."""
    design = np.column_stack([np.ones(len(PLACES)), PLACES - 0.5])
    lines = np.full((*off.shape[:2], 2), np.nan)
    spread = np.full(off.shape[:2], np.nan)
    for i in range(off.shape[0]):
        for j in range(4):
            good = np.isfinite(off[i, j])
            if length[i, j] < SMALLEST_SIDE_PX:
                continue
            for _ in range(4):
                if good.sum() < len(PLACES) // 2:
                    break
                fit = np.linalg.lstsq(design[good], off[i, j, good], rcond=None)[0]
                rest = np.abs(off[i, j] - design @ fit)
                lines[i, j], spread[i, j] = fit, float(np.sqrt(np.mean(rest[good] ** 2)))
                good &= rest < 3.7 * float(np.median(rest[good])) + 0.02
    return lines, spread


def _meetings(
    begin: Array, normal: Array, unit: Array, lines: Array, spread: Array, length: Array
) -> tuple[Array, Array]:
    """Where the line of each side meets that of the side before it."""
    slope = lines[..., 1] / length
    direction = unit + slope[..., None] * normal
    start = begin + (lines[..., 0] - 0.5 * lines[..., 1])[..., None] * normal
    before, way = np.roll(start, 1, axis=1), np.roll(direction, 1, axis=1)
    cross = direction[..., 0] * way[..., 1] - direction[..., 1] * way[..., 0]
    gap = before - start
    share = (gap[..., 0] * way[..., 1] - gap[..., 1] * way[..., 0]) / np.where(np.abs(cross) < 0.1, np.nan, cross)
    corners = start + share[..., None] * direction
    # At its end a line through n places is known to 2/√n of their spread.
    error = 2 / np.sqrt(len(PLACES)) * np.sqrt(0.5 * (spread**2 + np.roll(spread, 1, axis=1) ** 2))
    moved = np.linalg.norm(corners - begin, axis=-1)
    sigma = np.where(moved < 0.1 * length + 2, np.hypot(error, LEAST_SIDE_SIGMA_PX), np.nan)
    return corners.reshape(-1, 2), np.asarray(sigma, dtype=np.float64).ravel()

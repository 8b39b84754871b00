"""Grids of AprilTags in a picture: which tag is which is read, its corners come from the lines of its four sides.

A part of the grid is enough. Corners of tags are rounded by blur, their sides are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.charuco import best_dictionary
from cell.measure.vision.board.view import BoardSpec, BoardView, propose_counts
from cell.measure.vision.pictures import Image, PictureRefused, Reason

LEAST_TAGS = 4
# A tag lies where the others put it to this share of its side, its corners as they are first read to that one.
TOLERANCE, ROUGH = 0.15, 0.3
# Each side is measured at so many places between these shares of its length, across ± this share of it.
PLACES = np.linspace(0.12, 0.88, 16)
ACROSS = 0.09
STEPS, LEVEL = 33, 6
LEAST_SIGMA_PX = 0.01
SMALLEST_SIDE_PX = 12.0


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
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    best: tuple[Array, NDArray[np.intp]] = np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp)
    for border in (1, 2):
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        found, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
        if len(found) > len(best[1]):
            best = np.array(found, dtype=np.float64).reshape(-1, 4, 2), np.asarray(ids, dtype=np.intp).ravel()
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
    """Points of tags that are numbered from the last row upwards (`up`) or downwards, read from another corner.

    Squares that touch a tag's corners draw the corners first read inwards: the tags' middles count.
    """
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
    sigma = np.where(moved < 0.1 * length + 2, np.hypot(error, LEAST_SIGMA_PX), np.nan)
    return corners.reshape(-1, 2), np.asarray(sigma, dtype=np.float64).ravel()

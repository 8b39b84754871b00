"""Chessboards and ChArUco boards in a picture, also dark ones and with a laser line across.

Corners come in one order: x along the columns, y down the rows, z into the board, the first square black.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.geometry.camera import Array
from cell.vision.board_spec import BoardSpec
from cell.vision.board_view import BoardView
from cell.vision.pictures import Image, PictureRefused, Reason

LEAST_CORNERS = 6
SB_SIGMA_PX = 0.05
# Corners of the plain search are refined in a picture with its noise blurred away.
REFINE_BLUR_PX = 1.2
# A laser line is thinner than this and longer than this share of the picture.
STREAK_PX = 31
STREAK_SHARE = 0.15
# The search is done on at most this many px; corners are then refined in the picture itself.
SEARCH_PX = 1600


def find_chessboard(image: Image, spec: BoardSpec) -> BoardView:
    """The inner corners of a chessboard in an 8-bit image (h, w). Raises PictureRefused."""
    lit = _laser(image)
    smooth = cv2.GaussianBlur(image, (0, 0), REFINE_BLUR_PX)
    for corners, exact in _searches(image, lit, spec):
        half = _half_window(corners, spec)
        refined = corners
        if not exact:
            found = cv2.cornerSubPix(
                smooth,
                corners.astype(np.float32).reshape(-1, 1, 2),
                (half, half),
                (-1, -1),
                (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4),
            )
            refined = np.asarray(found, dtype=np.float64).reshape(-1, 2)
            if np.linalg.norm(refined - corners, axis=1).max() > half:
                continue
        ordered = _ordered(image, refined, spec)
        ids = np.flatnonzero(~_near(lit, ordered, half))
        if len(ids) < LEAST_CORNERS:
            raise PictureRefused(Reason.NO_BOARD, "the laser line covers the chessboard's corners; turn the laser off")
        sigma = np.full(len(ids), SB_SIGMA_PX)
        size = (image.shape[1], image.shape[0])
        return BoardView(spec, size, ids, ordered[ids], sigma, spec.symmetric)
    raise PictureRefused(
        Reason.NO_BOARD, f"no {spec.name} in the picture: show all of its squares with their white margin, in focus"
    )


def find_charuco(image: Image, spec: BoardSpec) -> BoardView:
    """The chessboard corners of a ChArUco board in an 8-bit image (h, w); a part of it is enough."""
    lit = _laser(image)
    best: tuple[Array, NDArray[np.intp]] | None = None
    for candidate in _variants(image, lit):
        for legacy in (False, True):
            found = _charuco_corners(candidate, spec, legacy)
            if found is not None and (best is None or len(found[1]) > len(best[1])):
                best = found
        if best is not None and len(best[1]) >= LEAST_CORNERS:
            break
    if best is None or len(best[1]) < LEAST_CORNERS:
        seen = 0 if best is None else len(best[1])
        raise PictureRefused(
            Reason.NO_BOARD,
            f"{seen} corners of {spec.name} were read, at least {LEAST_CORNERS} are needed: is the marker dictionary "
            "right, and the board in focus?",
        )
    corners, ids = best
    keep = ~_near(lit, corners, 5)
    if np.linalg.matrix_rank(np.column_stack([spec.lattice()[ids[keep]], np.ones(keep.sum())])) < 3 or keep.sum() < 4:
        raise PictureRefused(
            Reason.NO_BOARD, f"the corners of {spec.name} that were read lie on one line; show more of it"
        )
    sigma = np.full(int(keep.sum()), SB_SIGMA_PX)
    return BoardView(spec, (image.shape[1], image.shape[0]), ids[keep], corners[keep], sigma)


def _charuco_corners(image: Image, spec: BoardSpec, legacy: bool) -> tuple[Array, NDArray[np.intp]] | None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    board = cv2.aruco.CharucoBoard((spec.cols, spec.rows), spec.pitch, spec.marker, dictionary)
    board.setLegacyPattern(legacy)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters).detectBoard(image)
    if ids is None or len(ids) == 0:
        return None
    places: Array = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return places, np.asarray(ids, dtype=np.intp).ravel()


def _laser(image: Image) -> Image:
    """Mask (h, w) of long thin saturated streaks: a laser line, not the white of an over-exposed board or marker."""
    white = (image >= 250).astype(np.uint8)
    wide = cv2.morphologyEx(white, cv2.MORPH_OPEN, np.ones((STREAK_PX, STREAK_PX), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(cv2.subtract(white, wide), connectivity=8)
    mask = np.zeros_like(white)
    for label in range(1, count):
        x, y, w, h, area = stats[label]
        if np.hypot(w, h) < STREAK_SHARE * max(image.shape) or area > STREAK_PX * np.hypot(w, h):
            continue
        inside = labels[y : y + h, x : x + w] == label
        places = np.argwhere(inside).astype(np.float64)
        across = np.linalg.eigvalsh(np.cov(places.T))[0]
        if across < (STREAK_PX / 3) ** 2:
            mask[y : y + h, x : x + w][inside] = 1
    return np.asarray(cv2.dilate(mask, np.ones((9, 9), np.uint8)), dtype=np.uint8)


def _variants(image: Image, lit: Image) -> list[Image]:
    """The picture with its laser line painted over: stretched in contrast, as it is, evened out locally, blurred."""
    clean = image
    if lit.any():
        clean = np.asarray(cv2.inpaint(image, lit, 5, cv2.INPAINT_TELEA), dtype=np.uint8)
    low, high = np.percentile(clean, (0.5, 97))
    span = max(float(high - low), 8.0)
    stretched = np.clip((clean.astype(np.float32) - low) * (235 / span) + 10, 0, 255).astype(np.uint8)
    even = np.asarray(cv2.createCLAHE(4.0, (8, 8)).apply(stretched), dtype=np.uint8)
    return [stretched, clean, even, np.asarray(cv2.GaussianBlur(stretched, (0, 0), 1.5), dtype=np.uint8)]


def _searches(image: Image, lit: Image, spec: BoardSpec) -> Iterator[tuple[Array, bool]]:
    """Corners (n, 2) in some order of rows and whether they are exact, the quick and likely searches first.

    The sector-based search fits its corners over whole squares, better than a search around each corner does, unless
    its picture was shrunk or evened out.
    """
    stretched, clean, even, blurred = _variants(image, lit)
    size = (spec.cols, spec.rows)
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    normalised = cv2.CALIB_CB_NORMALIZE_IMAGE
    plan = (
        (stretched, 1.0, True, 0),
        (clean, 1.0, False, classic),
        (even, 1.0, True, normalised),
        (even, 0.5, True, normalised),
        (blurred, 1.0, True, 0),
        (stretched, 1.0, True, normalised),
        (stretched, 1.0, False, classic),
    )
    for picture, share, sector_based, flags in plan:
        scale = share * min(1.0, SEARCH_PX / max(image.shape))
        small = picture
        if scale < 1.0:
            small = np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        search = cv2.findChessboardCornersSB if sector_based else cv2.findChessboardCorners
        found, corners = search(small, size, flags=flags)
        if found and corners is not None and len(corners) == spec.cols * spec.rows:
            exact = sector_based and scale == 1.0 and picture is not even
            yield (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5, exact


def _half_window(corners: Array, spec: BoardSpec) -> int:
    """Half window for the sub-pixel search: well inside the squares that meet at a corner."""
    grid = corners.reshape(spec.rows, spec.cols, 2)
    sides = [np.linalg.norm(np.diff(grid, axis=a), axis=2).min() for a in (0, 1)]
    return int(np.clip(0.3 * min(sides), 2, 11))


def _ordered(image: Image, corners: Array, spec: BoardSpec) -> Array:
    """The corners in the board's order: x × y into the picture, and the first square black.

    Where the colours do not settle a half turn, the first corner is the one nearer the upper left of the picture.
    """
    grid = corners.reshape(spec.rows, spec.cols, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]
    if spec.symmetric:
        turn = grid[0, 0].sum() > grid[-1, -1].sum()
    else:
        turn = _first_square_is_white(image, grid)
    return np.ascontiguousarray(grid[::-1, ::-1] if turn else grid).reshape(-1, 2)


def _first_square_is_white(image: Image, grid: Array) -> bool:
    """Compare the inner squares of the first square's colour with the others."""
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    smooth = cv2.GaussianBlur(image, (5, 5), 0).astype(np.float64)
    j, i = np.indices(middles.shape[:2])
    x, y = np.round(middles[..., 0]).astype(int), np.round(middles[..., 1]).astype(int)
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    # The square between the corners (0, 0) and (1, 1) has the colour of the first square.
    like_first = (i + j) % 2 == 0
    values = smooth[y.clip(0, image.shape[0] - 1), x.clip(0, image.shape[1] - 1)]
    return bool(np.median(values[inside & like_first]) > np.median(values[inside & ~like_first]))


def _near(lit: Image, corners: Array, reach: int) -> NDArray[np.bool_]:
    """Corners (n,) whose surroundings of ± reach px contain laser light."""
    if not lit.any():
        return np.zeros(len(corners), dtype=np.bool_)
    wide = cv2.dilate(lit, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    x = np.round(corners[:, 0]).astype(int).clip(0, lit.shape[1] - 1)
    y = np.round(corners[:, 1]).astype(int).clip(0, lit.shape[0] - 1)
    return np.asarray(wide[y, x] > 0, dtype=np.bool_)

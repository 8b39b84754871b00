"""ChArUco boards in a picture: the markers say where every corner must be, a part of the board is enough.

Markers are read by OpenCV; one that does not lie where the others put it counts for nothing.
"""

from __future__ import annotations

from collections.abc import Iterator

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

LEAST_MARKERS = 3
# Markers that agree with one another but not with the board found, or that it does not have: a second board.
MOST_FOREIGN = 2
TOLERANCE = 0.2
# Each kind of marker with its smaller sets first: a smaller one is the likelier name for what both can read.
DICTIONARIES = (
    *(f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
    "DICT_ARUCO_MIP_36h12",
)


def find_charuco(image: Image, spec: BoardSpec) -> BoardView:
    """The chessboard corners of a ChArUco board in an 8-bit image (h, w). Raises PictureRefused."""
    most = 0
    for picture in _variants(image):
        corners, ids = _markers(picture, spec)
        most = max(most, len(ids))
        if len(ids) < LEAST_MARKERS:
            continue
        solutions = [
            _solve(spec, corners, ids, legacy) for legacy in ((False, True) if spec.rows % 2 == 0 else (False,))
        ]
        solved = [s for s in solutions if s is not None]
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
        corners, ids = _markers(picture, spec)
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
    best, name = 0, ""
    for candidate in DICTIONARIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, candidate))
        corners, _, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
        if len(corners) > best:
            best, name = len(corners), candidate
    return best, name


def _variants(image: Image) -> Iterator[Image]:
    """The picture stretched in contrast, evened out locally, and smoothed."""
    low, high = np.percentile(image[::4, ::4], (0.5, 97))
    span = max(float(high - low), 8.0)
    table = np.clip((np.arange(256) - low) * (235 / span) + 10, 0, 255).astype(np.uint8)
    stretched = np.asarray(cv2.LUT(image, table), dtype=np.uint8)
    yield stretched
    yield np.asarray(cv2.GaussianBlur(stretched, (0, 0), 1.5), dtype=np.uint8)
    yield np.asarray(cv2.createCLAHE(4.0, (8, 8)).apply(stretched), dtype=np.uint8)


def _markers(image: Image, spec: BoardSpec) -> tuple[Array, NDArray[np.intp]]:
    """Corners (n, 4, 2) in px of the markers read, and their ids (n,)."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    if not len(corners):
        return np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp)
    return np.array(corners, dtype=np.float64).reshape(-1, 4, 2), np.asarray(ids, dtype=np.intp).ravel()


def _layout(spec: BoardSpec, legacy: bool) -> Array:
    """Corners (n, 4, 2) of the markers in pitches from the first inner corner, in their reading order.

    The older layout of boards with an even number of rows begins with a marker, the present one with a black square.
    """
    j, i = np.divmod(np.arange(spec.cols * spec.rows), spec.cols)
    holds = (i + j) % 2 == (0 if legacy else 1)
    middle = np.column_stack([i[holds], j[holds]]) - 0.5
    half = 0.5 * spec.marker / spec.pitch
    return np.asarray(middle[:, None, :] + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), dtype=np.float64)


def _solve(
    spec: BoardSpec, corners: Array, ids: NDArray[np.intp], legacy: bool
) -> tuple[PlaneMap, NDArray[np.bool_], bool] | None:
    """The map of the board that most markers agree on, and which do (n,)."""
    layout = _layout(spec, legacy)
    own = ids < len(layout)
    if own.sum() < LEAST_MARKERS:
        return None
    places, pixels = layout[ids[own]].reshape(-1, 2), corners[own].reshape(-1, 2)
    side = float(np.median(np.linalg.norm(np.diff(corners[own], axis=1), axis=2))) * spec.pitch / spec.marker
    homography, inside = cv2.findHomography(places, pixels, cv2.RANSAC, max(2.0, TOLERANCE * side))
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
    steps = plane.steps(flat)
    measured, sigma, _ = fit_corners(image, plane.pixels(flat), steps, dark, share)
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

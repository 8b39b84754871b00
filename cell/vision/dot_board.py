"""A board of dots in a picture: blobs, lattice, identity, then every dot that the board says must be there.

Marked boards may be seen in part; the others must be seen to all their edges.
"""

from __future__ import annotations

import cv2
import numpy as np

from cell.geometry.camera import Array
from cell.vision.board_spec import BoardSpec
from cell.vision.board_view import BoardView
from cell.vision.dots import find_blobs, measure_dots
from cell.vision.identify import identify
from cell.vision.lattice import Blobs, Places, grow_lattice
from cell.vision.pictures import Image, PictureRefused, Reason

LEAST_SIGMA_PX = 0.01
LEAST_DOTS = 12
# Window of the local threshold as a share of the picture's larger side, most common first.
WINDOWS = (0.06, 0.12, 0.03, 0.25)


def find_dots(image: Image, spec: BoardSpec) -> BoardView:
    """The dots of `spec` in an 8-bit image (h, w). Raises PictureRefused with the most telling of its reasons."""
    refusals: list[PictureRefused] = []
    contrast = float(np.percentile(image, 97) - np.percentile(image, 3))
    for scale in (1, 2):
        picture = (
            image if scale == 1 else np.asarray(cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))
        )
        for share in WINDOWS:
            window = int(share * max(picture.shape)) | 1
            for offset in (max(4.0, 0.12 * contrast), max(2.0, 0.03 * contrast)):
                try:
                    return _attempt(np.asarray(picture, dtype=np.uint8), spec, window, offset, scale)
                except PictureRefused as refused:
                    refusals.append(refused)
    telling = [r for r in refusals if r.reason is Reason.MIRRORED] or [
        r for r in refusals if r.reason is Reason.AMBIGUOUS
    ]
    raise (telling or refusals[-1:])[0]


def _attempt(image: Image, spec: BoardSpec, window: int, offset: float, scale: int) -> BoardView:
    blobs = find_blobs(image, window, offset)
    least = LEAST_DOTS if spec.kind == "marked_dots" else max(4, int(0.85 * len(spec.lattice())))
    grown = grow_lattice(blobs, min(least, len(spec.lattice())))
    if grown is None:
        raise PictureRefused(Reason.NO_BOARD, f"no board: {len(blobs.centres)} dot-like spots, none in a lattice")
    index, places = grown
    dots, sigma, scores = measure_dots(image, blobs.take(index), rounds=2)
    board_places, assumed = identify(
        spec, _upright(places, dots.centres), np.where(np.isnan(sigma)[:, None], 0.0, scores)
    )
    known = np.asarray((board_places >= 0).all(axis=1), dtype=np.bool_)
    return _complete(image, spec, dots.take(known), board_places[known], assumed, scale)


def _upright(places: Places, pixels: Array) -> Places:
    """Lattice places turned by quarter turns so that the first step runs to the right in the picture."""
    fit = np.linalg.lstsq(np.column_stack([places, np.ones(len(places))]).astype(np.float64), pixels, rcond=None)[0]
    turns = int(np.round(np.arctan2(fit[0, 1], fit[0, 0]) / (np.pi / 2))) % 4
    turned = places
    for _ in range(turns):
        turned = np.column_stack([-turned[:, 1], turned[:, 0]])
    return turned


def _complete(image: Image, spec: BoardSpec, dots: Blobs, places: Places, assumed: bool, scale: int) -> BoardView:
    """Measure every dot of the board where the dots found so far say that it must be."""
    lattice = spec.lattice().astype(np.float64)
    homography, _ = cv2.findHomography(places.astype(np.float64), dots.centres, cv2.RANSAC, 3.0 * scale)
    if homography is None:
        raise PictureRefused(Reason.NO_BOARD, f"the dots found do not lie in a plane like those of {spec.name}")
    predicted, jacobian = _map(np.asarray(homography, dtype=np.float64), lattice)
    radius = _radius(dots, places, jacobian, lattice)
    height, width = image.shape
    shapes = radius * jacobian
    reach = 1.3 * np.linalg.norm(shapes, axis=(1, 2))
    visible = (predicted > reach[:, None]).all(axis=1) & (
        predicted < np.array([width - 1, height - 1]) - reach[:, None]
    ).all(axis=1)
    ids = np.flatnonzero(visible)
    start = predicted.copy()
    number = {tuple(p): k for k, p in enumerate(spec.lattice())}
    for place, centre in zip(places, dots.centres, strict=True):
        start[number[tuple(place)]] = centre
    measured, sigma, _ = measure_dots(image, Blobs(start[ids], shapes[ids]))
    ratio = measured.areas / Blobs(start[ids], shapes[ids]).areas
    away = np.linalg.norm(measured.centres - predicted[ids], axis=1)
    pitch = np.sqrt(np.abs(np.linalg.det(jacobian[ids])))
    good = np.isfinite(sigma) & (ratio > 0.6) & (ratio < 1.6) & (away < 0.25 * pitch)
    if good.sum() < (LEAST_DOTS if spec.kind == "marked_dots" else 0.85 * len(lattice)):
        raise PictureRefused(Reason.NO_BOARD, f"only {good.sum()} dots of {spec.name} could be measured")
    # Pixel (0, 0) is the middle of the upper left pixel at either scale.
    pixels = (measured.centres[good] + 0.5) / scale - 0.5
    size = (width // scale, height // scale)
    deviation = np.maximum(sigma[good] / scale, LEAST_SIGMA_PX)
    return BoardView(spec, size, ids[good], pixels, deviation, assumed, spec.dot_radius or radius * spec.pitch)


def _map(homography: Array, lattice: Array) -> tuple[Array, Array]:
    """Pixels (n, 2) of lattice places (n, 2), and ∂pixel/∂place (n, 2, 2)."""
    mapped = np.column_stack([lattice, np.ones(len(lattice))]) @ homography.T
    pixels = mapped[:, :2] / mapped[:, 2:]
    jacobian = (homography[None, :2, :2] - pixels[:, :, None] * homography[None, 2:, :2]) / mapped[:, 2, None, None]
    return pixels, jacobian


def _radius(dots: Blobs, places: Places, jacobian: Array, lattice: Array) -> float:
    """Radius of the dots in pitches, as seen."""
    number = {tuple(p): k for k, p in enumerate(lattice.astype(np.intp))}
    areas = np.abs(np.linalg.det(jacobian))[[number[tuple(p)] for p in places]]
    return float(np.median(np.sqrt(dots.areas / (np.pi * areas))))

"""A board of dots in a picture: blobs, lattice, identity, then every dot that the board says must be there.

Marked boards may be seen in part, the others must be seen to all their edges. Blobs come from a local threshold at
several scales; each dot is then measured by its edge (`dot_edges.py`).
"""

import cv2
import numpy as np
import scipy
from cv2.typing import MatLike

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.dot_edges import measure
from cell.measure.vision.board.ends import OtherBoard, check_dot_ends
from cell.measure.vision.board.lattice import LEAST_SHARE, Blobs, Places, PlaneMap, dot_lattices, identify
from cell.measure.vision.board.view import BoardSpec, BoardView
from cell.measure.vision.pictures import Image, PictureRefused, Reason, counts_of, only_one, percentile

LEAST_SIGMA_PX = 0.004
LEAST_DOTS = 12
SMALL_PX = 400_000
# Window of the local threshold as a share of the picture's larger side, most common first.
WINDOWS = (0.06, 0.12, 0.03, 0.25)
# Thresholds at which the only lattice is another board: further ones would find the same, sixteen times as slowly.
SURE = 2
LEAST_AREA_PX = 9.0
ROUNDS = 4


def find_dots(image: Image, spec: BoardSpec) -> BoardView:
    """The dots of `spec` in an 8-bit image (h, w). Raises PictureRefused with the most telling of its reasons."""
    refusals: list[PictureRefused] = []
    others = 0
    few = counts_of(image[::4, ::4])
    contrast = percentile(few, 97) - percentile(few, 3)
    # Enlarging helps small pictures of small dots, and only those.
    for scale in (1, 2) if image.size <= SMALL_PX else (1,):
        picture = image if scale == 1 else cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        for share in WINDOWS:
            window = int(share * max(picture.shape)) | 1
            for offset in (max(4.0, 0.12 * contrast), max(2.0, 0.03 * contrast)):
                views, reasons = _attempt(np.asarray(picture, dtype=np.uint8), spec, window, offset, scale)
                if views:
                    return only_one(views, spec.name)
                refusals += reasons
                others += len(reasons) == 1 and isinstance(reasons[0], OtherBoard)
                if others == SURE:
                    raise reasons[0]
    rank = (Reason.MIRRORED, Reason.AMBIGUOUS, Reason.NO_BOARD)
    raise min(refusals, key=lambda r: rank.index(r.reason))


def _attempt(
    image: Image, spec: BoardSpec, window: int, offset: float, scale: int
) -> tuple[list[BoardView], list[PictureRefused]]:
    """Every board of `spec` among the blobs of one threshold, and why the other lattices are none."""
    blobs = find_blobs(image, window, offset)
    least = LEAST_DOTS if spec.kind == "marked_dots" else max(4, int(LEAST_SHARE * len(spec.lattice())))
    views, reasons = [], []
    for index, places in dot_lattices(blobs, min(least, len(spec.lattice()))):
        try:
            grown = blobs.take(index)
            if spec.kind != "marked_dots":
                grown, places = _extended(image, grown, places, spec.name)
            dots, sigma, signs = _measured(image, grown, 2)
            scores = np.where(np.isnan(sigma)[:, None], 0.0, _ring_scores(signs))
            board_places, assumed = identify(spec, _upright(places, dots.centres), scores)
            known = np.asarray((board_places >= 0).all(axis=1), dtype=np.bool_)
            views.append(_complete(image, spec, dots.take(known), board_places[known], assumed=assumed, scale=scale))
        except PictureRefused as refused:
            reasons.append(refused)
    if not views and not reasons:
        text = f"no {spec.name}: {len(blobs.centres)} dot-like spots, no {least} of them in a lattice"
        reasons.append(PictureRefused(Reason.NO_BOARD, text))
    return views, reasons


def _extended(image: Image, dots: Blobs, places: Places, name: str) -> tuple[Blobs, Places]:
    """The lattice with the dots in its gaps and next to it that the threshold missed, as in a shadow's edge."""
    for _ in range(2):
        plane = PlaneMap.fit(places, dots.centres, 0.1 * float(np.ptp(dots.centres, axis=0).max()), name)
        low = places.min(axis=0) - 1
        held = np.zeros(np.ptp(places, axis=0) + 3)
        held[tuple((places - low).T)] = 1.0
        neighbours = scipy.ndimage.convolve(held, np.ones((3, 3)), mode="constant")
        beside = np.argwhere((held == 0.0) & (neighbours > 1.5)) + low
        if not len(beside):
            break
        flat = beside.astype(np.float64)
        middles, steps = plane.pixels(flat), plane.steps(flat)
        radius = _relative_radius(dots, plane.steps(places.astype(np.float64)))
        guess = Blobs(middles, radius * steps)
        seen, sigma = measure_dots(image, guess, rounds=3)
        ratio = seen.areas / guess.areas
        away = np.linalg.norm(seen.centres - middles, axis=1)
        good = np.isfinite(sigma) & (ratio > 0.75) & (ratio < 1.33) & (away < 0.15 * np.linalg.norm(steps, axis=(1, 2)))
        if not good.any():
            break
        new = seen.take(good)
        dots = Blobs(np.concatenate([dots.centres, new.centres]), np.concatenate([dots.shapes, new.shapes]))
        places = np.concatenate([places, beside[good]])
    return dots, places


def _upright(places: Places, pixels: Array) -> Places:
    """Lattice places turned by quarter turns so that the first step runs to the right in the picture."""
    fit = np.linalg.lstsq(np.column_stack([places, np.ones(len(places))]).astype(np.float64), pixels, rcond=None)[0]
    turns = int(np.round(np.arctan2(fit[0, 1], fit[0, 0]) / (np.pi / 2))) % 4
    return np.asarray(places @ np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), turns))


def _complete(image: Image, spec: BoardSpec, dots: Blobs, places: Places, assumed: bool, scale: int) -> BoardView:
    """Measure every dot of the board where the dots found so far say that it must be."""
    lattice = spec.lattice().astype(np.float64)
    plane = PlaneMap.fit(places, dots.centres, 3.0 * scale, spec.name)
    predicted, jacobian = plane.pixels(lattice), plane.steps(lattice)
    number = {tuple(p): k for k, p in enumerate(spec.lattice().tolist())}
    found = [number[tuple(p)] for p in places.tolist()]
    radius = _relative_radius(dots, jacobian[found])
    height, width = image.shape
    shapes = radius * jacobian
    reach = 1.3 * np.linalg.norm(shapes, axis=(1, 2))
    visible = (predicted > reach[:, None]).all(axis=1) & (
        predicted < np.array([width - 1, height - 1]) - reach[:, None]
    ).all(axis=1)
    ids = np.flatnonzero(visible)
    start = predicted.copy()
    start[found] = dots.centres
    # The shapes are the whole board's: each dot's own would turn and stretch its rays by its noise.
    begin = Blobs(start[ids], shapes[ids])
    seen, sigma = measure_dots(image, begin)
    ratio = seen.areas / begin.areas
    away = np.linalg.norm(seen.centres - predicted[ids], axis=1)
    pitch = np.sqrt(np.abs(np.linalg.det(jacobian[ids])))
    good = np.isfinite(sigma) & (ratio > 0.6) & (ratio < 1.6) & (away < 0.25 * pitch)
    if good.sum() < (LEAST_DOTS if spec.kind == "marked_dots" else LEAST_SHARE * len(lattice)):
        raise PictureRefused(Reason.NO_BOARD, f"only {good.sum()} dots of {spec.name} could be measured")
    check_dot_ends(image, spec, plane, ids[good], radius)
    # Pixel (0, 0) is the middle of the upper left pixel at either scale.
    pixels = (seen.centres[good] + 0.5) / scale - 0.5
    size = (width // scale, height // scale)
    # One dot's rays are few: half of its variance is what the board's other dots say.
    own = np.square(sigma[good] / scale)
    deviation = np.sqrt(0.5 * (own + np.median(own)) + LEAST_SIGMA_PX**2)
    dot_radius = spec.dot_radius or radius * spec.pitch
    return BoardView(spec, size, ids[good], pixels, deviation, order_assumed=assumed, dot_radius=dot_radius)


def _relative_radius(dots: Blobs, steps: Array) -> float:
    """Median radius of dots in pitches; `steps` (n, 2, 2) are ∂pixel/∂place at each."""
    return float(np.median(np.sqrt(dots.areas / (np.pi * np.abs(np.linalg.det(steps))))))


def find_blobs(image: Image, window: int, offset: float) -> Blobs:
    """Dark elliptic blobs: darker by `offset` DN than the mean of a `window` × `window` px neighbourhood."""
    smooth = cv2.GaussianBlur(image, (3, 3), 0)
    mean = cv2.blur(smooth, (window, window), borderType=cv2.BORDER_REPLICATE)
    _, dark = cv2.threshold(cv2.subtract(mean, smooth), int(offset), 255, cv2.THRESH_BINARY)
    # Grains of noise are opened away: what is not three pixels wide is too small for a dot.
    dark = np.asarray(cv2.morphologyEx(dark, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))))
    contours, hierarchy = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    # A contour with a parent is a hole, such as the middle of a ring.
    outer = [c for c, links in zip(contours, hierarchy[0] if contours else (), strict=True) if links[3] < 0]
    return _ellipses([c for c in outer if len(c) >= 8], (image.shape[1], image.shape[0]))


def _ellipses(outlines: list[MatLike], size: tuple[int, int]) -> Blobs:
    """Those of the outlines (m, 1, 2) that are whole and elliptic."""
    # Wholly in the picture, and no larger than a quarter of it.
    boxes = np.array([cv2.boundingRect(c) for c in outlines]).reshape(-1, 4)
    low, extent = boxes[:, :2], boxes[:, 2:]
    whole = (low > 0).all(axis=1) & (low + extent < size).all(axis=1) & (extent.max(axis=1) <= 0.25 * max(size))
    kept = [outlines[k] for k in np.flatnonzero(whole)]
    moments = [cv2.moments(c) for c in kept]
    names = ("m00", "m10", "m01", "mu20", "mu11", "mu02")
    area, sx, sy, xx, xy, yy = np.array([[m[name] for name in names] for m in moments]).reshape(-1, 6).T
    # A contour runs through pixel middles: it encloses half a pixel less all around.
    large = (area >= 4) & (area + 0.5 * np.array([len(c) for c in kept]) >= LEAST_AREA_PX)
    area, sx, sy, xx, xy, yy = (m[large] for m in (area, sx, sy, xx, xy, yy))
    second = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2) / area[:, None, None]
    values, vectors = np.linalg.eigh(4 * second)
    # The area of an ellipse of these second moments: the ratio is 1 for ellipses and less for other shapes.
    with np.errstate(invalid="ignore", divide="ignore"):
        roundness = area / (np.pi * np.sqrt(values[:, 0] * values[:, 1]))
    good = (values[:, 0] > 0) & (values[:, 0] >= 0.03 * values[:, 1]) & (roundness > 0.87) & (roundness < 1.1)
    radii = np.sqrt(values[good]) + 0.5
    shapes = np.einsum("nij,nj,nkj->nik", vectors[good], radii, vectors[good])
    return Blobs((np.column_stack([sx, sy]) / area[:, None])[good], shapes)


def measure_dots(image: Image, start: Blobs, rounds: int = ROUNDS) -> tuple[Blobs, Array]:
    """Dots re-measured from their edges, and the deviation (n,) of each centre in px; NaN for an edge not all seen."""
    return _measured(image, start, rounds)[:2]


def _measured(image: Image, start: Blobs, rounds: int) -> tuple[Blobs, Array, Array]:
    """As `measure_dots`, with what tells a ring (n, 4)."""
    centres, shapes = start.centres.copy(), start.shapes.copy()
    sigma, signs = np.full(len(centres), np.nan), np.zeros((len(centres), 4))
    measure(np.require(image, requirements=("C", "W")), centres, shapes, rounds, sigma=sigma, signs=signs)
    # A dot that wandered off its blob measures something else.
    wandered = np.linalg.norm(np.linalg.solve(start.shapes, (centres - start.centres)[:, :, None])[:, :, 0], axis=1)
    sigma[wandered > 0.7] = np.nan
    return Blobs(centres, shapes), sigma, signs


def _ring_scores(signs: Array) -> Array:
    """Two signs of a ring (n, 2): brightness of the middle between dot (0) and board (1), and missing darkness. The
    second, the dot's whole darkness against the median of all dots, survives blur: a ring lacks a quarter of it."""
    middle, rim, bright, darkness = signs.T
    missing = 1 - darkness / max(float(np.median(darkness)), 1e-9)
    return np.column_stack([(middle - rim) / np.maximum(bright - rim, 1.0), missing])

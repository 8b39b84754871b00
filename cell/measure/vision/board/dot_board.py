"""A board of dots in a picture: blobs, lattice, identity, then every dot that the board says must be there.

Marked boards may be seen in part; the others must be seen to all their edges.
"""

from __future__ import annotations

import cv2
import numpy as np

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.dots import find_blobs, measure_dots, tell_dots
from cell.measure.vision.board.ends import OtherBoard, check_dot_ends
from cell.measure.vision.board.identify import LEAST_SHARE, identify
from cell.measure.vision.board.lattice import Blobs, Places, PlaneMap, dot_lattices
from cell.measure.vision.board.view import BoardSpec, BoardView
from cell.measure.vision.pictures import Image, PictureRefused, Reason, counts_of, only_one, percentile

LEAST_SIGMA_PX = 0.004
LEAST_DOTS = 12
SMALL_PX = 400_000
AROUND = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]
# Window of the local threshold as a share of the picture's larger side, most common first.
WINDOWS = (0.06, 0.12, 0.03, 0.25)
SURE = 2
"""Thresholds at which the only lattice is another board: further ones would find the same, sixteen times as slowly."""


def find_dots(image: Image, spec: BoardSpec) -> BoardView:
    """The dots of `spec` in an 8-bit image (h, w). Raises PictureRefused with the most telling of its reasons."""
    refusals: list[PictureRefused] = []
    others = 0
    few = counts_of(image[::4, ::4])
    contrast = percentile(few, 97) - percentile(few, 3)
    # Enlarging helps small pictures of small dots, and only those.
    for scale in (1, 2) if image.size <= SMALL_PX else (1,):
        picture = (
            image if scale == 1 else np.asarray(cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))
        )
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
            if spec.kind != "marked_dots":
                grown, places = _extended(image, blobs.take(index), places, spec.name)
            else:
                grown = blobs.take(index)
            dots, sigma, scores = tell_dots(image, grown)
            board_places, assumed = identify(
                spec, _upright(places, dots.centres), np.where(np.isnan(sigma)[:, None], 0.0, scores)
            )
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
        low, high = places.min(axis=0) - 1, places.max(axis=0) + 1
        grid = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
        held = {tuple(p) for p in places.tolist()}
        beside = [
            p
            for p in grid.tolist()
            if tuple(p) not in held and sum((p[0] + a, p[1] + b) in held for a, b in AROUND) >= 2
        ]
        if not beside:
            break
        flat = np.array(beside, dtype=np.float64)
        middles, steps = plane.pixels(flat), plane.steps(flat)
        radius = _relative_radius(dots, plane.steps(places.astype(np.float64)))
        guess = Blobs(middles, radius * steps)
        measured, sigma = measure_dots(image, guess, rounds=3)
        ratio = measured.areas / guess.areas
        away = np.linalg.norm(measured.centres - middles, axis=1)
        good = np.isfinite(sigma) & (ratio > 0.75) & (ratio < 1.33) & (away < 0.15 * np.linalg.norm(steps, axis=(1, 2)))
        if not good.any():
            break
        new = measured.take(good)
        dots = Blobs(np.concatenate([dots.centres, new.centres]), np.concatenate([dots.shapes, new.shapes]))
        places = np.concatenate([places, np.array(beside, dtype=np.intp)[good]])
    return dots, places


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
    plane = PlaneMap.fit(places, dots.centres, 3.0 * scale, spec.name)
    predicted, jacobian = plane.pixels(lattice), plane.steps(lattice)
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
    measured, sigma = measure_dots(image, Blobs(start[ids], shapes[ids]))
    ratio = measured.areas / Blobs(start[ids], shapes[ids]).areas
    away = np.linalg.norm(measured.centres - predicted[ids], axis=1)
    pitch = np.sqrt(np.abs(np.linalg.det(jacobian[ids])))
    good = np.isfinite(sigma) & (ratio > 0.6) & (ratio < 1.6) & (away < 0.25 * pitch)
    if good.sum() < (LEAST_DOTS if spec.kind == "marked_dots" else LEAST_SHARE * len(lattice)):
        raise PictureRefused(Reason.NO_BOARD, f"only {good.sum()} dots of {spec.name} could be measured")
    check_dot_ends(image, spec, plane, ids[good], radius)
    # Pixel (0, 0) is the middle of the upper left pixel at either scale.
    pixels = (measured.centres[good] + 0.5) / scale - 0.5
    size = (width // scale, height // scale)
    # One dot's rays are few: half of its variance is what the board's other dots say.
    own = np.square(sigma[good] / scale)
    deviation = np.sqrt(0.5 * (own + np.median(own)) + LEAST_SIGMA_PX**2)
    return BoardView(
        spec,
        size,
        ids[good],
        pixels=pixels,
        sigma=deviation,
        order_assumed=assumed,
        dot_radius=spec.dot_radius or radius * spec.pitch,
    )


def _radius(dots: Blobs, places: Places, jacobian: Array, lattice: Array) -> float:
    """Radius of the dots in pitches, as seen."""
    number = {tuple(p): k for k, p in enumerate(lattice.astype(np.intp))}
    return _relative_radius(dots, jacobian[[number[tuple(p)] for p in places]])


def _relative_radius(dots: Blobs, steps: Array) -> float:
    """Median radius of dots in pitches; `steps` (n, 2, 2) are ∂pixel/∂place at each."""
    return float(np.median(np.sqrt(dots.areas / (np.pi * np.abs(np.linalg.det(steps))))))

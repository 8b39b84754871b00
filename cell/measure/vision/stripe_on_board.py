"""Which stripe points lie on the board's plane, away from everything printed on it.

The stripe runs on beyond the board, onto its bent edge or the floor, and its centre is drawn aside where it crosses
from white to black. Both kinds of points are left out, by geometry first and by the straightness of the rest.
"""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.vision.board.view import DOTS, BoardSpec
from cell.measure.vision.stripe.profile import StripeProfile
from drivers.errors import RefusedError

# How far beyond the outermost points there is board for certain, in pitches.
MARGIN_PITCHES = {"marked_dots": 0.8, "asymmetric_dots": 0.8, "dots": 0.8, "chessboard": 2.0, "charuco": 1.5}
# Further out, the stripe is followed as long as it stays straight within this share of the board's diagonal, no further
# than the diagonal itself.
FLATNESS = 0.003
STRAIGHTNESS = 4.0
LONGEST_GAP = 8
LEAST_POINTS = 20


def on_plane(camera: CameraModel, camera_from_board: pin.SE3, pixels: Array) -> Array:
    """Points (n, 3) in m in the camera frame where pixels (n, 2) meet the board's plane; NaN where they do not."""
    rays = camera.rays(pixels)
    normal = camera_from_board.rotation[:, 2]
    slant = rays @ normal
    distance = float(normal @ camera_from_board.translation)
    reach = np.divide(distance, slant, out=np.full(len(rays), np.nan), where=np.abs(slant) > 1e-6)
    reach[~(reach > 0)] = np.nan
    return np.asarray(rays * reach[:, None], dtype=np.float64)


def points_on_board(
    camera: CameraModel, camera_from_board: pin.SE3, spec: BoardSpec, profile: StripeProfile, dot_radius: float
) -> NDArray[np.intp]:
    """Rows of the profile whose stripe lies cleanly on the board, empty when too few; `RefusedError` without room."""
    rows = profile.rows
    if spec.kind not in MARGIN_PITCHES:
        raise RefusedError(f"no stripe is read on {spec.name}; take a board of these: {', '.join(MARGIN_PITCHES)}")
    seen = on_plane(camera, camera_from_board, profile.pixels())
    local = (seen - camera_from_board.translation) @ camera_from_board.rotation
    points = spec.points()[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN_PITCHES[spec.kind] * spec.pitch
    diagonal = float(np.linalg.norm(high - low + 2 * spec.pitch))
    # The stripe's half width on the board: σ in px times metres per pixel.
    half = 2.5 * profile.width[rows] * np.abs(seen[:, 2]) / camera.fx
    usable = ~profile.double[rows] & _clear_of_print(local[:, :2], half, spec, dot_radius)
    index = np.flatnonzero(usable & _within(local, low - margin, high + margin))
    if len(index) < LEAST_POINTS:
        return np.empty(0, dtype=np.intp)
    index = index[_straight(local[index, :2])]
    if len(index) < LEAST_POINTS:
        return np.empty(0, dtype=np.intp)
    beyond = np.flatnonzero(usable & _within(local, low - diagonal, high + diagonal))
    index = _followed(local[:, :2], index, beyond, FLATNESS * diagonal)
    return np.asarray(rows[index], dtype=np.intp)


def _within(local: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        inside = (local[:, :2] > low) & (local[:, :2] < high)
    return np.asarray(inside.all(axis=1), dtype=np.bool_)


def _followed(
    local: Array, trusted: NDArray[np.intp], candidates: NDArray[np.intp], tolerance: float
) -> NDArray[np.intp]:
    """The trusted points and those beyond them, up to where the stripe leaves their line or breaks."""
    centre = local[trusted].mean(axis=0)
    direction, across = np.linalg.svd(local[trusted] - centre, full_matrices=False)[2]
    away = np.abs((local - centre) @ across)
    length = (local[trusted] - centre) @ direction
    # A short stretch says little about the direction further out.
    allowed = tolerance * np.clip(np.abs((local - centre) @ direction) / max(float(np.ptp(length)), 1e-9), 1.0, 3.0)
    good = set(candidates[away[candidates] < allowed[candidates]].tolist())
    kept = set(trusted.tolist())
    for start, stop, step in ((int(trusted.max()), len(local), 1), (int(trusted.min()), -1, -1)):
        gap = 0
        for i in range(start, stop, step):
            if i in good:
                kept.add(i)
                gap = 0
            elif (gap := gap + 1) > LONGEST_GAP:
                break
    return np.array(sorted(kept), dtype=np.intp)


def _clear_of_print(local: Array, half: Array, spec: BoardSpec, dot_radius: float) -> NDArray[np.bool_]:
    """True (n,) where a stripe of half width `half` (n,) in m touches no edge of a dot or square."""
    known = np.asarray(np.isfinite(local).all(axis=1), dtype=np.bool_)
    at = np.where(known[:, None], local, 0.0)
    if spec.kind in DOTS:
        nearest = np.linalg.norm(at[:, None, :] - spec.points()[None, :, :2], axis=2).min(axis=1)
        return np.asarray(known & (nearest > dot_radius + half), dtype=np.bool_)
    cols, rows = spec.grid
    inside = ((at > -spec.pitch - half[:, None]) & (at < np.array([cols, rows]) * spec.pitch + half[:, None])).all(
        axis=1
    )
    to_edge = np.abs(at / spec.pitch - np.round(at / spec.pitch)).min(axis=1) * spec.pitch
    if spec.kind == "charuco":
        return np.asarray(known & ~inside, dtype=np.bool_)
    return np.asarray(known & (~inside | (to_edge > half)), dtype=np.bool_)


def _straight(local: Array) -> NDArray[np.intp]:
    """Indices of the points (n, 2) that lie on one line: light plane and board plane meet in a line."""
    kept = np.arange(len(local))
    for _ in range(10):
        centre = np.median(local[kept], axis=0)
        _, _, vt = np.linalg.svd(local[kept] - local[kept].mean(axis=0), full_matrices=False)
        away = (local - centre) @ vt[1]
        away -= np.median(away[kept])
        scatter = 1.4826 * float(np.median(np.abs(away[kept])))
        new = np.flatnonzero(np.abs(away) < STRAIGHTNESS * max(scatter, 1e-6))
        if len(new) == len(kept) and (new == kept).all():
            break
        if len(new) < LEAST_POINTS:
            return np.empty(0, dtype=np.intp)
        kept = new
    return kept

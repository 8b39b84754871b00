"""The paper's calibration of the light plane, section 4.1, its six steps a function each.

They need no arm: dots and stripe of several views give the plane in the camera's frame. The joint adjustment starts
from it, and it stays as a cross-check of the adjusted plane. Step 2 comes first, because a row of dots is a straight
line only once the lens's distortion is taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.calibration.solve.starts import zhang
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane, triangulate
from cell.measure.geometry.poses import transform
from cell.measure.vision.board.board import board_pose, predict
from cell.measure.vision.board.view import BoardView
from cell.measure.vision.stripe_on_board import on_plane
from drivers.errors import RefusedError

LEAST_IN_ROW = 3
# Crossings further out than this many pitches beyond a row's last dot are extrapolated too far.
BEYOND_PITCHES = 1.0
# Points on fewer than two views, or nearly on one line (second spread below this share of the first), make no plane.
LEAST_VIEWS, LEAST_SPREAD = 2, 0.02


@dataclass(frozen=True, eq=False)
class Crossing:
    """Where the stripe crosses one row (or column) of the board: `place` (2,) in the ideal picture at unit distance.

    `dots` (k,) are the row's points in the view, `axis` the board axis (0: x, 1: y) along which the row runs.
    """

    place: Array
    dots: NDArray[np.intp]
    axis: int


@dataclass(frozen=True, eq=False)
class PaperPlane:
    """The light plane of the six steps: RMS distance in m of its feature points, their number and that of the views.

    `cross_ratio_m`: RMS in m along the rows between the places by cross ratio and by the board's pose, NaN for none.
    `measured_m`: RMS in m between the feature points triangulated with the plane (step 6) and those of the board (4).
    """

    plane: LightPlane
    rms: float
    features: int
    views: int
    cross_ratio_m: float
    measured_m: float


def paper_plane(
    camera: CameraModel,
    camera_from_board: Sequence[pin.SE3],
    views: Sequence[BoardView],
    stripes: Sequence[Array],
) -> PaperPlane:
    """Steps 1 and 3 to 6 on views whose camera and poses step 2 gave; `stripes` are pixels (n, 2) on the boards.

    Raises RefusedError when the stripe crosses too few rows for a plane.
    """
    pixels, globals_, apart, seen = [], [], [], 0
    for pose, view, stripe in zip(camera_from_board, views, stripes, strict=True):
        ideal = ideal_centres(camera, pose, view)
        crossings = step_1_stripe_crosses_rows(camera, view, ideal, stripe)
        if not crossings:
            continue
        seen += 1
        local = np.array([step_3_keep_the_cross_ratio(c, view, ideal) for c in crossings])
        places = camera.project([[*c.place, 1.0] for c in crossings])
        by_pose = (on_plane(camera, pose, places) - pose.translation) @ pose.rotation
        apart += [b[c.axis] - x[c.axis] for b, x, c in zip(by_pose, local, crossings, strict=True)]
        pixels.append(places)
        globals_.append(step_4_local_to_global(pose, local))
    if not pixels:
        raise RefusedError("the stripe crosses no row of the board in any view; does it lie across the board?")
    points = np.concatenate(globals_)
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if seen < LEAST_VIEWS or len(points) < 3 or spread[1] < LEAST_SPREAD * spread[0]:
        raise RefusedError(
            f"the stripe crosses rows of the board in {seen} views, all along one line; a light plane needs the board "
            "at different distances or tilts"
        )
    plane, kept = step_5_fit_the_plane(points)
    measured = step_6_measure_the_features(camera, plane, np.concatenate(pixels)[kept])
    return PaperPlane(
        plane,
        _rms(plane.distances(points[kept])),
        int(kept.sum()),
        views=seen,
        cross_ratio_m=_rms(np.array(apart)),
        measured_m=_rms(np.linalg.norm(measured - points[kept], axis=1)),
    )


def step_1_stripe_crosses_rows(camera: CameraModel, view: BoardView, ideal: Array, stripe: Array) -> list[Crossing]:
    """Step 1: a line through the stripe, a line through each row of dots, and where they cross, to sub-pixel.

    `ideal` (n, 2) are the dots in the ideal picture, `stripe` (m, 2) pixels. Columns serve instead of rows where the
    stripe crosses them more squarely.
    """
    if len(stripe) < 2:
        return []
    line = _line(camera.normalised(stripe))
    families = [_family(view, ideal, line, axis) for axis in (0, 1)]
    slants = [np.median(slant) if len(slant) else 0.0 for _, slant in families]
    return families[int(np.argmax(slants))][0]


def step_2_one_coordinate_system(
    views: Sequence[BoardView], nominal: CameraModel | None = None, lens: bool = True
) -> tuple[CameraModel, Array, list[pin.SE3]]:
    """Step 2: picture and space in one coordinate system: the camera, the RMS in px of each view (n,), the boards.

    The camera is Zhang's; each pose camera_from_board is refined on the circles' images.
    """
    camera, rms = zhang(views, nominal, lens)
    return camera, rms, [board_pose(view, camera).camera_from_board for view in views]


def step_3_keep_the_cross_ratio(crossing: Crossing, view: BoardView, ideal: Array) -> Array:
    """Step 3: the crossing's place (3,) in m on the board, from cross ratios, which a projection does not change.

    The projective map of a line that keeps them is fitted to all dots of the row; with three it is the cross ratio
    with those three.
    """
    row, at = ideal[crossing.dots], view.object_points[crossing.dots]
    middle = row.mean(axis=0)
    along = np.linalg.svd(row - middle, full_matrices=False)[2][0]
    t, x = (row - middle) @ along, at[:, crossing.axis]
    scale = np.abs(t).max()
    t = t / scale
    here = float((crossing.place - middle) @ along / scale)
    # x (1 + c t) = a t + b
    a, b, c = np.linalg.lstsq(np.column_stack([t, np.ones_like(t), -x * t]), x, rcond=None)[0]
    local = at[0].copy()
    local[crossing.axis] = (a * here + b) / (1 + c * here)
    return np.asarray(local, dtype=np.float64)


def step_4_local_to_global(camera_from_board: pin.SE3, local: Array) -> Array:
    """Step 4: feature points (n, 3) from each board's own frame to the one frame of the camera, in m."""
    return transform(camera_from_board, local)


def step_5_fit_the_plane(points: Array) -> tuple[LightPlane, NDArray[np.bool_]]:
    """Step 5: least-squares plane of points (n, 3) in m, and which were kept (n,): those far from it are left out."""
    keep = np.ones(len(points), dtype=np.bool_)
    plane = LightPlane.fit(points)
    for _ in range(5):
        away = np.abs(plane.distances(points))
        keep = away < 4 * 1.4826 * max(float(np.median(away)), 1e-9)
        plane = LightPlane.fit(points[keep])
    return plane, keep


def step_6_measure_the_features(camera: CameraModel, plane: LightPlane, pixels: Array) -> Array:
    """Step 6: three-dimensional coordinates (n, 3) in m of feature points by their pixels (n, 2) and the plane."""
    return triangulate(camera, plane, pixels)[0]


def ideal_centres(camera: CameraModel, camera_from_board: pin.SE3, view: BoardView) -> Array:
    """The view's points (n, 2) at unit distance without distortion, dots moved from ellipse centre to circle centre."""
    points = view.object_points
    centre = camera.project(transform(camera_from_board, points))
    return camera.normalised(view.pixels + centre - predict(camera, camera_from_board, points, view.dot_radius))


def _family(view: BoardView, ideal: Array, line: Array, axis: int) -> tuple[list[Crossing], list[float]]:
    """Crossings with the rows along a board axis, and the sine of the angle of each in the picture."""
    local = view.object_points
    crossings, slants = [], []
    for value in np.unique(local[:, 1 - axis]):
        dots = np.flatnonzero(local[:, 1 - axis] == value)
        if len(dots) < LEAST_IN_ROW:
            continue
        row = _line(ideal[dots])
        meeting = np.cross(row, line)
        if abs(meeting[2]) < 1e-6:
            continue
        place = meeting[:2] / meeting[2]
        ends = ideal[dots[np.argsort(local[dots, axis])]]
        span = ends[-1] - ends[0]
        share = float((place - ends[0]) @ span / (span @ span))
        room = BEYOND_PITCHES * view.spec.pitch / float(np.ptp(local[dots, axis]))
        if -room < share < 1 + room:
            crossings.append(Crossing(place, dots, axis))
            slants.append(float(abs(meeting[2])))
    return crossings, slants


def _line(points: Array) -> Array:
    """Homogeneous line (3,) with a unit normal that fits points (n, 2) best."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][1]
    return np.array([normal[0], normal[1], -float(normal @ centre)])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")

"""Closed forms that the adjustment starts from: Zhang's camera, Park and Martin's hand-eye, the paper's light plane.

The stripe points that are chosen here are those that the joint adjustment uses. The hand-eye's rotation comes first,
then one linear system for everything that is a translation, the rail's included."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import difference, from_parts, mean, perturbed, transform
from cell.measure.vision.board.board import predict
from cell.measure.vision.board.view import BoardView
from cell.measure.vision.stripe.profile import StripeProfile
from cell.measure.vision.stripe_on_board import on_plane, points_on_board
from drivers.errors import RefusedError

LEAST_VIEWS = 3


def zhang(views: Sequence[BoardView], nominal: CameraModel | None = None, lens: bool = True) -> CameraModel:
    """Camera of several views of a board; `nominal` is a start where it is known. Without `lens` it has no distortion.
    Raises RefusedError for fewer than three views, or none that tell the focal length."""
    if len(views) < LEAST_VIEWS:
        raise RefusedError(
            f"{len(views)} views of the board; a camera's calibration needs {LEAST_VIEWS} or more from different sides"
        )
    width, height = views[0].size
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if not lens:
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    matrix: Array = np.eye(3)
    dist: Array = np.zeros(5)
    if nominal is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        matrix, dist = nominal.matrix, np.array(nominal.dist, dtype=np.float64)
    objects = [v.object_points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32).reshape(-1, 1, 2) for v in views]
    threads = cv2.getNumThreads()
    # On several threads it adds up in whatever order they come, so that the last digits differ from time to time.
    cv2.setNumThreads(1)
    try:
        found = cv2.calibrateCamera(objects, pixels, (width, height), matrix, dist, flags=flags)
    except cv2.error as error:
        raise RefusedError(
            f"the {len(views)} views do not determine a camera: {error.err}; tilt the board more"
        ) from error
    finally:
        cv2.setNumThreads(threads)
    matrix, dist = np.asarray(found[1], dtype=np.float64), np.asarray(found[2], dtype=np.float64).ravel()[:5]
    camera = CameraModel(width, height, 1.0, fy=1.0, cx=0.0, cy=0.0).with_parameters(
        [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *dist]
    )
    if not 0.1 * max(width, height) < camera.fx < 100 * max(width, height):
        raise RefusedError(
            f"the {len(views)} views do not determine a camera (focal length {camera.fx:.0f} px); tilt the board more"
        )
    return camera


@dataclass(frozen=True, eq=False)
class PlaneStart:
    """A light plane, the RMS distance in m of its points, and the rows of each view's stripe that lie on the board."""

    plane: LightPlane
    rms: float
    rows: list[NDArray[np.intp]]


def plane_from_board(
    camera: CameraModel,
    camera_from_board: Sequence[pin.SE3],
    views: Sequence[BoardView],
    profiles: Sequence[StripeProfile | None],
) -> PlaneStart:
    """All stripe points on the boards' planes in the camera frame, and their plane. Frames whose stripe misses the
    board give no rows. Raises RefusedError when all points lie on one line."""
    rows, points = [], []
    for pose, view, profile in zip(camera_from_board, views, profiles, strict=True):
        if profile is None:
            rows.append(np.empty(0, dtype=np.intp))
            continue
        rows.append(points_on_board(camera, pose, view.spec, profile, view.dot_radius))
        if len(rows[-1]):
            points.append(on_plane(camera, pose, stripe_pixels(profile, rows[-1])))
    if not points:
        raise RefusedError(
            "no frame shows the laser stripe on the board; is the laser on, and does it cross the board?"
        )
    cloud = np.concatenate(points)
    spread = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False) / np.sqrt(len(cloud))
    if len(points) < 2 or spread[1] < LEAST_SPREAD * spread[0]:
        raise RefusedError(
            f"the stripe was seen on the board in {len(points)} frames, all along one line; a light plane needs the "
            "board at different distances or tilts"
        )
    plane, rms = robust_plane(cloud)
    return PlaneStart(plane, rms, rows)


def robust_plane(cloud: Array) -> tuple[LightPlane, float]:
    """Plane of points (n, 3) in m without those that lie off it, and the RMS distance in m of the rest."""
    keep = np.ones(len(cloud), dtype=np.bool_)
    plane = LightPlane.fit(cloud)
    for _ in range(5):
        away = np.abs(plane.distances(cloud))
        keep = away < 4 * 1.4826 * max(float(np.median(away)), 1e-9)
        plane = LightPlane.fit(cloud[keep])
    return plane, float(np.sqrt(np.mean(plane.distances(cloud[keep]) ** 2)))


def stripe_pixels(profile: StripeProfile, rows: NDArray[np.intp]) -> Array:
    """Pixels (n, 2) of some rows of a profile."""
    pair = (profile.centres[rows], rows.astype(np.float64))
    return np.column_stack(pair if profile.axis == "rows" else pair[::-1])


def stripe_means(profile: StripeProfile, rows: NDArray[np.intp], count: int) -> tuple[Array, Array]:
    """Pixels (m, 2) and σ (m,) of about `count` to twice as many means of neighbouring rows (n,), weighted by their σ.
    Over so few rows a stripe on a plane is straight, and the mean of points of a line is on the line."""
    bins = rows // max(1, len(rows) // count)
    weight = 1 / profile.sigma[rows] ** 2
    _, member = np.unique(bins, return_inverse=True)
    total = np.bincount(member, weight)
    pixels = stripe_pixels(profile, rows)
    means = [np.bincount(member, weight * pixels[:, axis]) / total for axis in (0, 1)]
    return np.column_stack(means), 1 / np.sqrt(total)


LEAST_IN_ROW = 3
BEYOND_PITCHES = 1.0
"""Crossings further beyond a row's last dot than so many pitches are extrapolated too far."""
LEAST_SPREAD = 0.02
"""Share of the first spread of points below which the second makes them one line, and no plane."""


@dataclass(frozen=True, eq=False)
class Crossing:
    """Where the stripe crosses one row (or column) of the board: `place` (2,) in the ideal picture at unit distance.
    `dots` (k,) are the row's points in the view, `axis` the board axis (0: x, 1: y) along which the row runs."""

    place: Array
    dots: NDArray[np.intp]
    axis: int


def paper_plane(camera: CameraModel, crossed: Sequence[tuple[pin.SE3, BoardView, Array]]) -> tuple[LightPlane, float]:
    """The light plane by section 4.1 of the paper, and the RMS distance of its points in m.

    `crossed` are camera_from_board, the view, and pixels (n, 2) of the stripe on the board. Step 2, camera and poses,
    comes before: a row of dots is a straight line only without distortion. Raises RefusedError when the stripe crosses
    too few rows for a plane.
    """
    points, seen = [], 0
    for pose, view, stripe in crossed:
        ideal = _ideal_centres(camera, pose, view)
        crossings = _rows_crossed(camera, view, ideal, stripe)
        if crossings:
            seen += 1
            # Step 4: from the board's frame to the camera's.
            points.append(transform(pose, np.array([at_cross_ratio(c, view, ideal) for c in crossings])))
    if not points:
        raise RefusedError("the stripe crosses no row of the board in any view; does it lie across the board?")
    cloud = np.concatenate(points)
    spread = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    if seen < 2 or len(cloud) < 3 or spread[1] < LEAST_SPREAD * spread[0]:
        raise RefusedError(
            f"the stripe crosses rows of the board in {seen} views, all along one line; a light plane needs the board "
            "at different distances or tilts"
        )
    return robust_plane(cloud)


def _rows_crossed(camera: CameraModel, view: BoardView, ideal: Array, stripe: Array) -> list[Crossing]:
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


def at_cross_ratio(crossing: Crossing, view: BoardView, ideal: Array) -> Array:
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


def _ideal_centres(camera: CameraModel, camera_from_board: pin.SE3, view: BoardView) -> Array:
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
        meeting = np.cross(_line(ideal[dots]), line)
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


LEAST_TURN = np.deg2rad(2.0)
LEAST_AXES_SINE = 0.05


@dataclass(frozen=True, eq=False)
class HandEye:
    """flange_from_camera (at rail position 0), the rail's travel per metre of reading (3,) in camera axes, the board.
    `scatter_m` and `scatter_rad`: RMS, over the views, of how far the board of one view lies from `base_from_board`."""

    flange_from_camera: pin.SE3
    rail_direction: Array
    base_from_board: pin.SE3
    scatter_m: float
    scatter_rad: float


def park_martin(base_from_flange: Sequence[pin.SE3], camera_from_board: Sequence[pin.SE3]) -> Array:
    """Rotation (3, 3) flange_from_camera from pairs of poses, from the rotation vectors of all relative motions. Raises
    RefusedError when the flange was not turned about two different axes."""
    moment = np.zeros((3, 3))
    axes = []
    for i, j in combinations(range(len(base_from_flange)), 2):
        hand = pin.log3(base_from_flange[j].rotation.T @ base_from_flange[i].rotation)
        eye = pin.log3(camera_from_board[j].rotation @ camera_from_board[i].rotation.T)
        if LEAST_TURN < np.linalg.norm(hand) < 0.95 * np.pi and np.linalg.norm(eye) < 0.98 * np.pi:
            moment += np.outer(eye, hand)
            axes.append(hand)
    spread = np.linalg.svd(np.array(axes), compute_uv=False) if len(axes) > 1 else np.zeros(2)
    if spread[1] < LEAST_AXES_SINE * max(spread[0], 1e-9) or spread[0] == 0:
        raise RefusedError(
            f"{len(base_from_flange)} views turn the flange about one axis at most; hand-eye needs turns of more than "
            f"{np.degrees(LEAST_TURN):.0f}° about two different axes"
        )
    u, _, vt = np.linalg.svd(moment)
    return np.asarray(vt.T @ np.diag([1.0, 1.0, float(np.linalg.det(vt.T @ u.T))]) @ u.T, dtype=np.float64)


def solve_hand_eye(
    base_from_flange: Sequence[pin.SE3],
    camera_from_board: Sequence[pin.SE3],
    rail: Sequence[float] | None = None,
    nominal_direction: Array | None = None,
) -> HandEye:
    """Hand-eye of a camera on the flange that sees a board at rest, from pairs of poses. With rail readings in m that
    differ, the rail's direction and scale are solved too; else `nominal_direction` holds."""
    rotation = park_martin(base_from_flange, camera_from_board)
    readings = np.zeros(len(base_from_flange)) if rail is None else np.asarray(rail, dtype=np.float64)
    with_rail = np.ptp(readings) > 1e-3
    nominal = np.zeros(3) if nominal_direction is None else np.asarray(nominal_direction, dtype=np.float64)
    rows, right = [], []
    for flange, board, s in zip(base_from_flange, camera_from_board, readings, strict=True):
        # base position of the board's origin: R_F (R_X c + s m + t) + t_F = b, linear in m, t and b.
        known = board.translation if with_rail else board.translation + s * nominal
        m_part = s * flange.rotation if with_rail else np.zeros((3, 3))
        rows.append(np.hstack([flange.rotation, -np.eye(3), m_part]))
        right.append(-flange.rotation @ rotation @ known - flange.translation)
    solution = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    direction = rotation.T @ solution[6:] if with_rail else nominal
    flange_from_camera = from_parts(solution[:3], rotation)
    return _scatter(base_from_flange, camera_from_board, readings, flange_from_camera, direction)


BALANCE = 0.3


def refine_hand_eye(
    base_from_flange: Sequence[pin.SE3], camera_from_board: Sequence[pin.SE3], start: HandEye
) -> tuple[HandEye, Array, Array]:
    """Hand-eye and board together by robust least squares on the poses; 1 rad counts like `BALANCE` m.

    Also the deviations (6,) of the hand-eye, m and rad, by leaving each pair out in turn, and how far (n,) in m each
    left-out pair puts the board from where the others do. For pairs of poses without pictures; where there are
    pictures the joint adjustment does better. The rail rests.
    """
    hand_eye, board = start.flange_from_camera, start.base_from_board
    weight = np.repeat([1.0, BALANCE], 3)

    def residuals(x: pin.SE3, b: pin.SE3) -> Array:
        return np.array(
            [difference(f * x * c, b) * weight for f, c in zip(base_from_flange, camera_from_board, strict=True)]
        )

    for _ in range(30):
        here = residuals(hand_eye, board)
        columns = []
        for k in range(12):
            d = np.zeros(12)
            d[k] = 1e-6
            moved = residuals(perturbed(hand_eye, d[:6]), perturbed(board, d[6:]))
            columns.append(((moved - here) / 1e-6).ravel())
        size = np.linalg.norm(here, axis=1)
        robust = 1 / (1 + (size / (2 * np.median(size) + 1e-12)) ** 2)
        root = np.repeat(np.sqrt(robust), 6)
        design, right = np.column_stack(columns) * root[:, None], -here.ravel() * root
        step = np.linalg.lstsq(design, right, rcond=None)[0]
        hand_eye, board = perturbed(hand_eye, step[:6]), perturbed(board, step[6:])
        if np.abs(step).max() < 1e-12:
            break
    count = len(base_from_flange)
    found = _scatter(base_from_flange, camera_from_board, np.zeros(count), hand_eye, start.rail_direction)
    blocks, rights = design.reshape(count, 6, 12), right.reshape(count, 6)
    whole, pull = design.T @ design, design.T @ right
    steps = np.array(
        [np.linalg.lstsq(whole - j.T @ j, pull - j.T @ r, rcond=None)[0] for j, r in zip(blocks, rights, strict=True)]
    )
    off = np.array(
        [
            np.linalg.norm(difference(f * perturbed(hand_eye, d[:6]) * c, perturbed(board, d[6:]))[:3])
            for f, c, d in zip(base_from_flange, camera_from_board, steps, strict=True)
        ]
    )
    spread = steps[:, :6] - steps[:, :6].mean(axis=0)
    return found, np.sqrt((count - 1) / count * np.sum(spread**2, axis=0)), off


def _scatter(
    base_from_flange: Sequence[pin.SE3], camera_from_board: Sequence[pin.SE3], rail: Array,
    flange_from_camera: pin.SE3, direction: Array,
) -> HandEye:  # fmt: skip
    boards = [
        f * flange_from_camera * from_parts(s * direction) * c
        for f, c, s in zip(base_from_flange, camera_from_board, rail, strict=True)
    ]
    middle = mean(boards)
    apart = np.array([difference(b, middle) for b in boards])
    squares = np.mean(apart**2, axis=0)
    return HandEye(
        flange_from_camera, direction, middle, float(np.sqrt(squares[:3].sum())), float(np.sqrt(squares[3:].sum()))
    )

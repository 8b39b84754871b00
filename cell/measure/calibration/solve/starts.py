"""Closed-form starts: Zhang's camera, and a light plane through all clean stripe points on the boards.

The stripe points that are chosen here are those that the joint adjustment uses. The paper's own way to the plane is in
`paper_steps`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.vision.board.view import BoardView
from cell.measure.vision.stripe.extract import StripeProfile
from cell.measure.vision.stripe_on_board import on_plane, points_on_board
from drivers.errors import RefusedError

LEAST_VIEWS = 3


def zhang(
    views: Sequence[BoardView], nominal: CameraModel | None = None, lens: bool = True
) -> tuple[CameraModel, Array]:
    """Camera of several views of a board, and the RMS in px of each view (n,).

    `nominal` is a start where it is known. Without `lens` no distortion is estimated. Raises RefusedError for fewer
    than three views, or none that tell the focal length.
    """
    if len(views) < LEAST_VIEWS:
        raise RefusedError(
            f"{len(views)} views of the board; a camera's calibration needs {LEAST_VIEWS} or more from different sides"
        )
    size = views[0].size
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
        result = cv2.calibrateCameraExtended(objects, pixels, size, matrix, dist, flags=flags)
    except cv2.error as error:
        raise RefusedError(
            f"the {len(views)} views do not determine a camera: {error.err}; tilt the board more"
        ) from error
    finally:
        cv2.setNumThreads(threads)
    matrix = np.asarray(result[1], dtype=np.float64)
    dist = np.asarray(result[2], dtype=np.float64).ravel()[:5]
    per_view = np.asarray(result[7], dtype=np.float64).ravel()
    camera = CameraModel(size[0], size[1], 1.0, fy=1.0, cx=0.0, cy=0.0).with_parameters(
        [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *dist]
    )
    if not 0.1 * max(size) < camera.fx < 100 * max(size):
        raise RefusedError(
            f"the {len(views)} views do not determine a camera (focal length {camera.fx:.0f} px); tilt the board more"
        )
    # OpenCV's figure is per point; ours everywhere is per component.
    return camera, np.asarray(per_view / np.sqrt(2), dtype=np.float64)


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
    """All stripe points on the boards' planes in the camera frame, and their plane.

    Frames whose stripe misses the board give no rows. Raises RefusedError when all points lie on one line.
    """
    rows, points = [], []
    for pose, view, profile in zip(camera_from_board, views, profiles, strict=True):
        chosen = (
            np.empty(0, dtype=np.intp)
            if profile is None
            else points_on_board(camera, pose, view.spec, profile, view.dot_radius)
        )
        rows.append(chosen)
        if profile is not None and len(chosen):
            points.append(on_plane(camera, pose, stripe_pixels(profile, chosen)))
    if not points:
        raise RefusedError(
            "no frame shows the laser stripe on the board; is the laser on, and does it cross the board?"
        )
    cloud = np.concatenate(points)
    spread = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False) / np.sqrt(len(cloud))
    if len(points) < 2 or spread[1] < 0.02 * spread[0]:
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

    Over so few rows a stripe on a plane is straight, and the mean of points of a line is on the line.
    """
    bins = rows // max(1, len(rows) // count)
    weight = 1 / profile.sigma[rows] ** 2
    _, member = np.unique(bins, return_inverse=True)
    total = np.bincount(member, weight)
    pixels = stripe_pixels(profile, rows)
    means = [np.bincount(member, weight * pixels[:, axis]) / total for axis in (0, 1)]
    return np.column_stack(means), 1 / np.sqrt(total)

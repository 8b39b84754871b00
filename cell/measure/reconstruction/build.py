"""From stripe profiles to the organised cloud: each profile is triangulated as it arrives, no frame is kept.

Stripe pixel → ray → light plane while the frames come; carriage and flange → arm base once the sweep has ended and it
is known where they were (paper, equation 2 with the calibrated sweep direction; docs/explanation/theory.md, section 2).
What belongs to the surface and what does not is decided in `outliers`.

How the cloud would move if calibration, flange or vehicle were elsewhere, each within its uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane, triangulate
from cell.measure.reconstruction.cloud import Array, Cloud
from cell.measure.reconstruction.outliers import find_outliers
from cell.measure.vision.stripe.profile import StripeProfile


@dataclass(frozen=True)
class ScanGeometry:
    """What triangulation needs to know of the scan head. `rail_direction` (3,): metres that the camera moves, in camera
    axes, per metre of rail reading (direction times scale). `flange_from_camera` holds at rail position 0."""

    camera: CameraModel
    light_plane: LightPlane
    rail_direction: Array
    flange_from_camera: pin.SE3

    def solve(self, pixels: Array, rail: Array) -> tuple[Array, Array]:
        """Points (n, 3) in the flange frame and ∂point/∂pixel (n, 3, 2) of stripe pixels (n, 2) at rail (n,) m."""
        seen, by_pixel = triangulate(self.camera, self.light_plane, pixels)
        rotation = self.flange_from_camera.rotation
        moved = seen + np.asarray(rail)[:, None] * self.rail_direction
        points = moved @ rotation.T + self.flange_from_camera.translation
        return np.asarray(points), np.asarray(rotation @ by_pixel)


class ProfileBuilder:
    """Collects the profiles of one sweep as points in the camera's frame, and places them when the sweep is over."""

    def __init__(self, geometry: ScanGeometry, expected_lines: int = 256) -> None:
        self.geometry = geometry
        self._rows = geometry.camera.height
        self._lines = 0
        room = max(1, expected_lines)
        self._points = np.full((room, self._rows, 3), np.nan)
        self._spread = np.zeros((room, self._rows, 3), dtype=np.float32)
        self._centres = np.full((room, self._rows), np.nan)

    @property
    def lines(self) -> int:
        """Profiles so far."""
        return self._lines

    def see(self, profile: StripeProfile) -> int:
        """Triangulate a profile in the camera's frame, as the next line; the number of its points. `ValueError` when
        the profile is not one centre per row of this camera."""
        if profile.axis != "rows" or len(profile.centres) != self._rows:
            raise ValueError(
                f"a profile of {len(profile.centres)} {profile.axis} does not fit a camera of {self._rows} rows"
            )
        if self._lines == len(self._points):
            # Double the room for lines.
            more = len(self._points)
            self._points = np.concatenate([self._points, np.full((more, self._rows, 3), np.nan)])
            self._spread = np.concatenate([self._spread, np.zeros((more, self._rows, 3), dtype=np.float32)])
            self._centres = np.concatenate([self._centres, np.full((more, self._rows), np.nan)])
        line, rows = self._lines, profile.rows
        points, by_pixel = triangulate(self.geometry.camera, self.geometry.light_plane, profile.pixels())
        self._points[line, rows] = points
        self._spread[line, rows] = by_pixel[:, :, 0] * profile.sigma[rows, None]
        self._centres[line, rows] = profile.centres[rows]
        self._lines += 1
        return int(np.count_nonzero(np.isfinite(points[:, 0])))

    def seen(self, since: int) -> Array:
        """The profiles from number `since` on, (lines, rows, 3) m in the camera's frame; NaN where no point is."""
        return np.asarray(self._points[since : self._lines])

    def centres(self, line: int) -> Array:
        """Columns (rows,) in px at which the stripe was found in a profile; NaN where it was not."""
        return np.asarray(self._centres[line])

    def sweep_direction(self, base_from_flange: pin.SE3) -> Array:
        """Metres (3,) that the camera moves in the arm base, per metre of rail reading."""
        mount = self.geometry.flange_from_camera.rotation
        return np.asarray(base_from_flange.rotation @ mount @ np.asarray(self.geometry.rail_direction))

    def place(self, lines: NDArray[np.intp], flanges: Array, rail: Array, line_spread: Array) -> Cloud:
        """The organised cloud in the arm base of some of the profiles seen, outliers removed.

        `lines` (n,): which profiles, in the order that they lie beside each other; for each of them base_from_flange
        `flanges` (n, 4, 4), the `rail`'s position (n,) in m, and `line_spread` (n, 3): where one standard deviation
        of the line's place along the sweep moves its points, m in base axes.
        """
        geometry = self.geometry
        lines = np.asarray(lines, dtype=np.intp)
        whole = len(lines) > 0 and bool(np.all(np.diff(lines) == 1))
        which = slice(int(lines[0]), int(lines[-1]) + 1) if whole else lines
        carriage = np.asarray(rail)[:, None] * geometry.rail_direction
        turn = flanges[:, :3, :3] @ geometry.flange_from_camera.rotation
        origin = np.einsum("nij,j->ni", flanges[:, :3, :3], geometry.flange_from_camera.translation)
        origin = origin + flanges[:, :3, 3] + np.einsum("nij,nj->ni", turn, carriage)
        back = turn.transpose(0, 2, 1)
        points = np.matmul(self._points[which], back)
        points += origin[:, None]
        spread = np.matmul(self._spread[which], back.astype(np.float32))
        view = turn[len(lines) // 2, :, 2] if len(lines) else np.array([0.0, 0.0, 1.0])
        rejected = find_outliers(points @ view, np.abs(spread @ view.astype(np.float32)))
        points[rejected] = np.nan
        return Cloud(
            points=points, stripe_spread=spread, rail_spread=np.asarray(line_spread, dtype=np.float64),
            centres=self._centres[which].copy(), rail=np.asarray(rail, dtype=np.float64), rejected=rejected,
            flanges=np.array(flanges), sweeps=np.zeros(len(lines), dtype=np.intp),
        )  # fmt: skip


def calibration_motions(
    cloud: Cloud, lines: NDArray[np.intp], rows: NDArray[np.intp], base_from_flange: pin.SE3 | None,
    geometry: ScanGeometry, variants: Sequence[ScanGeometry],
) -> Array:  # fmt: skip
    """(n, 3, m) displacements in m, base axes, of the n points at (lines, rows) under each of m other geometries.

    The flange stood at `base_from_flange`, or with None where the cloud itself says for each line. With variants along
    the columns of a square root of the calibration's covariance, the sum of the outer products of a point's
    displacements is the covariance that the calibration leaves it with.
    """
    pixels = np.column_stack([cloud.centres[lines, rows], rows.astype(np.float64)])
    nominal, _ = geometry.solve(pixels, cloud.rail[lines])
    turns = cloud.flanges[lines, :3, :3] if base_from_flange is None else base_from_flange.rotation[None]
    motions = np.empty((len(lines), 3, len(variants)))
    for k, variant in enumerate(variants):
        points, _ = variant.solve(pixels, cloud.rail[lines])
        motions[:, :, k] = np.matmul(turns, (points - nominal)[:, :, None])[:, :, 0]
    return motions


def flange_motions(
    cloud: Cloud, lines: NDArray[np.intp], rows: NDArray[np.intp], covariances: Sequence[Array]
) -> Array:
    """(n, 3, 6 s) displacements in m, base axes, of the points at (lines, rows) by what the poses of s sweeps may err.

    `covariances`: for each sweep, the (6, 6) of base_from_flange (translation, rotation; base axes) that its lines have
    in common. The errors of different sweeps are independent: each moves the points of its own sweep only.
    """
    sweeps = cloud.sweep_of[lines]
    arms = cloud.points[lines, rows] - cloud.flanges[lines, :3, 3]
    motions = np.zeros((len(lines), 3, 6 * len(covariances)))
    for k, covariance in enumerate(covariances):
        values, vectors = np.linalg.eigh(covariance)
        mine = np.flatnonzero(sweeps == k)
        for i, column in enumerate((vectors * np.sqrt(np.maximum(values, 0.0))).T):
            motions[mine, :, 6 * k + i] = column[:3] + np.cross(column[3:], arms[mine])
    return motions


def lean_motions(
    cloud: Cloud, lines: NDArray[np.intp], rows: NDArray[np.intp], base_from_vehicle: pin.SE3, sigma: float
) -> Array:
    """(n, 3, 2) displacements in m, base axes, of the points at (lines, rows) by how the vehicle leans meanwhile.

    On its suspension it rolls and pitches about its own origin, towards where the arm reaches out, by `sigma` rad per
    metre each: one standard deviation of two springs. The arm base leans with it, so that what stands still in the
    world seems to move when the arm does. Told against the lean in the middle of all lines.
    """
    turn = base_from_vehicle.rotation
    flanges = cloud.flanges[:, :3, 3]
    reach = (flanges[lines] - flanges.mean(axis=0)) @ turn
    arms = cloud.points[lines, rows] - base_from_vehicle.translation
    motions = np.empty((len(lines), 3, 2))
    for k, (axis, amount) in enumerate(((turn[:, 0], -reach[:, 1]), (turn[:, 1], reach[:, 0]))):
        motions[:, :, k] = np.cross(axis, arms) * (-sigma * amount[:, None])
    return motions

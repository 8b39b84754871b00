"""From stripe profiles to the organised cloud: each profile is triangulated as it arrives, no frame is kept.

Stripe pixel → ray → light plane → carriage position → flange → arm base (paper, equation 2 with the calibrated sweep
direction; theory sheet, part 1). What belongs to the surface and what does not is decided in `outliers`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.geometry.camera import CameraModel
from cell.geometry.light_plane import LightPlane, triangulate
from cell.reconstruction.cloud import Array, Cloud
from cell.reconstruction.outliers import find_outliers
from cell.vision.stripe import StripeProfile
from drivers.errors import RefusedError


@dataclass(frozen=True)
class ScanGeometry:
    """What triangulation needs to know of the scan head.

    `rail_direction` (3,): metres that the camera moves, in camera axes, per metre of rail reading (direction times
    scale). `flange_from_camera` holds at rail position 0.
    """

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
    """Collects the profiles of one sweep as points in the flange frame."""

    def __init__(self, geometry: ScanGeometry, expected_lines: int = 256) -> None:
        self.geometry = geometry
        self._rows = geometry.camera.height
        self._lines = 0
        room = max(1, expected_lines)
        self._points = np.full((room, self._rows, 3), np.nan)
        self._spread = np.zeros((room, self._rows, 3), dtype=np.float32)
        self._centres = np.full((room, self._rows), np.nan)
        self._rail = np.zeros((room, 2))

    @property
    def lines(self) -> int:
        """Profiles so far."""
        return self._lines

    def add(self, profile: StripeProfile, rail_position: float, rail_sigma: float) -> int:
        """Triangulate one profile taken at `rail_position` ± `rail_sigma` (m); the number of its points.

        `ValueError` when the profile is not one centre per row of this camera.
        """
        if profile.axis != "rows" or len(profile.centres) != self._rows:
            raise ValueError(
                f"a profile of {len(profile.centres)} {profile.axis} does not fit a camera of {self._rows} rows"
            )
        if self._lines == len(self._points):
            self._grow()
        line, rows = self._lines, profile.rows
        points, by_pixel = self.geometry.solve(profile.pixels(), np.full(len(rows), rail_position))
        self._points[line, rows] = points
        self._spread[line, rows] = by_pixel[:, :, 0] * profile.sigma[rows, None]
        self._centres[line, rows] = profile.centres[rows]
        self._rail[line] = rail_position, rail_sigma
        self._lines += 1
        return int(np.count_nonzero(np.isfinite(points[:, 0])))

    def finish(self, base_from_flange: pin.SE3, least_points: int = 500) -> Cloud:
        """The organised cloud in the arm base, outliers removed; the flange stood at `base_from_flange` all along.

        Raises `RefusedError` when fewer than `least_points` points are left.
        """
        n = self._lines
        order = np.argsort(self._rail[:n, 0], kind="stable")
        points, spread, centres = self._points[order], self._spread[order], self._centres[order]
        view = self.geometry.flange_from_camera.rotation[:, 2]
        rejected = find_outliers(points @ view, np.abs(spread @ view.astype(np.float32)))
        rotation = base_from_flange.rotation
        points = (points.reshape(-1, 3) @ rotation.T + base_from_flange.translation).reshape(points.shape)
        points[rejected] = np.nan
        along = rotation @ self.geometry.flange_from_camera.rotation @ np.asarray(self.geometry.rail_direction)
        cloud = Cloud(
            points=points,
            stripe_spread=(spread.reshape(-1, 3) @ rotation.T.astype(np.float32)).reshape(spread.shape),
            rail_spread=self._rail[order, 1:] * along,
            centres=centres,
            rail=self._rail[order, 0],
            rejected=rejected,
        )
        if cloud.size < least_points:
            raise RefusedError(
                f"the sweep gave {cloud.size} points in {n} profiles ({int(rejected.sum())} rejected), at least "
                f"{least_points} are needed. Check that the laser lights the surface, and the scan camera's exposure"
            )
        return cloud

    def _grow(self) -> None:
        """Double the room for lines."""
        more = len(self._points)
        self._points = np.concatenate([self._points, np.full((more, self._rows, 3), np.nan)])
        self._spread = np.concatenate([self._spread, np.zeros((more, self._rows, 3), dtype=np.float32)])
        self._centres = np.concatenate([self._centres, np.full((more, self._rows), np.nan)])
        self._rail = np.concatenate([self._rail, np.zeros((more, 2))])

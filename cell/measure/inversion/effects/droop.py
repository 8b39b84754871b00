"""A scan head's carriage that sinks along its travel: seen as a bow of the scan along the rail, stated as a tilt.

A worn guide lets the carriage sink by the square of its way. The scanned surface then seems bowed the other way; the
constant and the even slope of that go into the pose, unseen. The bow tells how large they may be. A surface that is
bent along the sweep looks the same, so the pose is not corrected: what the carriage may have done to it is added to
its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.measure.inversion.closest import Array
from cell.measure.inversion.correspondences import Scan, correspondences
from cell.measure.inversion.nominal import NominalSurface
from cell.measure.reconstruction.cloud import Cloud, Indices

GATE_M = 0.5e-3
LEAST_LINES, LEAST_SHARE = 40, 0.1
LEAST_POINTS = 8
LEAST_SAG = 36e-6
"""At the end of the travel, m. Calibration and facets make a bow of up to 33 µm (docs/explanation/theory.md, section
8)."""
EVIDENCE = 4.0
"""The bow over its own standard deviation."""
BLOCK = 12
"""Neighbouring lines whose errors count as one: they share facets of the drawing and the part's form."""
ROLL = 10.0
"""How far the carriage rolls about its way while it sinks, rad per m: guides 0.1 m apart, of which one is worn."""


@dataclass(frozen=True, eq=False)
class Head:
    """The scan head in the base for each line of a cloud: the `cameras` (lines, 3) m, their optical `axes` and the
    `ways` of the rail, unit vectors (lines, 3), and the carriage's way as a `share` (lines,) of its travel."""

    cameras: Array
    axes: Array
    ways: Array
    share: Array

    @classmethod
    def of(
        cls, cloud: Cloud, base_from_flange: pin.SE3, flange_from_camera: pin.SE3, rail_direction: Array, travel: float
    ) -> Head:
        """`rail_direction` is the camera's travel per metre of the rail in its own frame; `base_from_flange` holds
        where the cloud does not tell the flange of each line."""
        flanges = cloud.flanges if len(cloud.flanges) else np.tile(base_from_flange.homogeneous, (cloud.shape[0], 1, 1))
        cameras = flanges @ flange_from_camera.homogeneous
        moved = cameras[:, :3, :3] @ rail_direction
        ways = moved / np.linalg.norm(rail_direction)
        return cls(cameras[:, :3, 3] + cloud.rail[:, None] * moved, cameras[:, :3, 2], ways, cloud.rail / travel)


@dataclass(frozen=True, eq=False)
class Droop:
    """How far the carriage may have sunk at the end of its travel: `sag`, m, and its standard deviation `sigma`."""

    sag: float
    sigma: float
    head: Head

    def motions(self, cloud: Cloud, lines: Indices, rows: Indices) -> Array:
        """(n, 3, 2) displacements in m, base axes, of the points at (lines, rows): by the sag and by the roll."""
        head = self.head
        sunk = np.hypot(self.sag, self.sigma) * head.share[lines, None] ** 2
        arms = cloud.points[lines, rows] - head.cameras[lines]
        return np.stack([sunk * head.axes[lines], sunk * ROLL * np.cross(head.ways[lines], arms)], axis=2)

    @property
    def words(self) -> str:
        """For people."""
        return (
            f"the scan is bowed along the rail, as if its carriage had sunk by {1e3 * abs(self.sag):.2f} ± "
            f"{1e3 * self.sigma:.2f} mm at the end of its travel, or the surface were bent; the stated uncertainty "
            "allows for the carriage. Look for play in its guide, then run `cell calibrate`"
        )


def find_droop(cloud: Cloud, nominal: NominalSurface, base_from_surface: pin.SE3, head: Head) -> Droop | None:
    """The sag that a scan shows at the pose found; None without any, and where the carriage stood still."""
    measured = bow(cloud, nominal, base_from_surface, head)
    if measured is None:
        return None
    sag, sigma = measured
    return Droop(sag, sigma, head) if abs(sag) > max(LEAST_SAG, EVIDENCE * sigma) else None


def bow(cloud: Cloud, nominal: NominalSurface, pose: pin.SE3, head: Head) -> tuple[float, float] | None:
    """The sag that fits best and its standard deviation, m; each sweep may lie and lean by itself."""
    scan = Scan.of(cloud)
    found = correspondences(pose, scan, nominal, GATE_M)
    of = scan.lines[found.index]
    facing = np.einsum("ni,ni->n", found.normals, head.axes[of])
    count = np.bincount(of, minlength=cloud.shape[0])
    good = count >= LEAST_POINTS
    if np.count_nonzero(good) < LEAST_LINES or float(np.ptp(head.share[good])) < LEAST_SHARE:
        return None
    # Least squares of each line: how far it lies off along the camera's axis.
    square = np.bincount(of, facing**2, minlength=cloud.shape[0])[good]
    off = np.bincount(of, facing * found.heights, minlength=cloud.shape[0])[good] / np.maximum(square, 1e-6)
    sweeps = cloud.sweeps[good] if len(cloud.sweeps) else np.zeros(len(off), dtype=np.intp)
    way = head.share[good]
    own = (sweeps[:, None] == np.unique(sweeps)).astype(np.float64)
    columns = np.hstack([(way**2)[:, None], own, own * way[:, None]])
    inverse = np.linalg.pinv(columns)
    sizes = inverse @ off
    left = off - columns @ sizes
    # What neighbouring lines share counts once.
    blocks = np.arange(len(off)) // BLOCK
    moved = np.array([inverse[0, blocks == k] @ left[blocks == k] for k in range(blocks[-1] + 1)])
    return float(sizes[0]), float(np.linalg.norm(moved))

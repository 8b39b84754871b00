"""What the planned sweeps will see of the drawn surface: the stripe on it, line by line, as the scan head is drawn.

Everything is in the surface frame S, as if the arm's base were there. No noise and no blur: which points there will be,
and how a stripe's centre that is off by `STRIPE_PX` moves each of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.apps.new_job.rays import SMOOTH, Array, Rays
from cell.check.reach import nominal_scan
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.measure.geometry.light_plane import triangulate
from cell.measure.geometry.poses import from_parts
from cell.measure.inversion.correspondences import SIGMA_FLOOR
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.arm.camera_poses import ScanPlan, scan_plans

STRIPE_PX = 0.12
"""One standard deviation of a stripe's centre, px: what speckle leaves on a matt surface."""
LINE_STEP, ROWS = 0.001, 160
"""Lines of the sweep that are looked at, m apart, and places along each stripe."""
PATCH = 2
"""Places along the stripe to each side, about half a millimetre, that a point needs around it to count."""
NEAREST, FARTHEST = 0.100, 0.165
"""How near and how far, m, a surface may be from the scan camera: beyond, its stripe is too broad, and too far from the
depths at which the head is calibrated."""
GRAZING = 0.2
"""Cosine beyond which light or sight graze the surface too much for a stripe."""


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """What one sweep sees: `points` (lines, rows, 3) m and their `normals`, NaN where there is none, `spread` (lines,
    rows, 3) m by the stripe's noise, the `flanges` (lines, 4, 4), the `rail` (lines,), m, and the way of the sweep.

    `eyes` and `lamps` (lines, 3) are where camera and laser were, m.
    """

    points: Array
    normals: Array
    spread: Array
    flanges: Array
    rail: Array
    along: Array
    eyes: Array
    lamps: Array

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(lines, rows) where there is a point."""
        return np.isfinite(self.points[:, :, 0])

    @property
    def solid(self) -> NDArray[np.bool_]:
        """(lines, rows) the points that lie within a smooth patch: along the stripe and in a neighbouring line the
        surface goes on as it is. On a narrower one a stripe is bent, and at an edge it is mixed."""
        valid = self.valid
        same = np.ones(valid.shape, dtype=np.bool_)
        for step in (-PATCH, PATCH):
            same &= _alike(self.normals, np.roll(self.normals, step, axis=1))
        beside = [_alike(self.normals, np.roll(self.normals, step, axis=0)) for step in (-1, 1)]
        same[:, :PATCH] = same[:, -PATCH:] = False
        return np.asarray(valid & same & (beside[0] | beside[1]))

    def information(self, used: NDArray[np.bool_]) -> Array:
        """(6, 6) of the surface's pose (translation m, rotation rad; S) that the points `used` (lines, rows) give."""
        points, normals = self.points[used], self.normals[used]
        sigma = np.hypot(np.einsum("ni,ni->n", self.spread[used], normals), SIGMA_FLOOR)
        rows = np.concatenate([normals, np.cross(points, normals)], axis=1) / sigma[:, None]
        return np.asarray(rows.T @ rows)


def _alike(normals: Array, others: Array) -> NDArray[np.bool_]:
    return np.asarray(np.einsum("lri,lri->lr", normals, others) > SMOOTH)


def look(config: CellConfig, job: Job, rays: Rays) -> list[SeenSurface]:
    """What each of the job's sweeps sees of the surface that `rays` meet, as drawn."""
    return [
        _sweep(config, job, plan, rays) for plan in scan_plans(config, job, pin.SE3.Identity(), nominal_scan(config))
    ]


def _sweep(config: CellConfig, job: Job, plan: ScanPlan, rays: Rays) -> SeenSurface:
    head = nominal_scan(config)
    count = max(12, int(job.scan.length / LINE_STEP) + 1)
    shares = np.linspace(0.0, 1.0, count)
    rail = plan.rail_start + shares * (plan.rail_stop - plan.rail_start)
    way = plan.base_from_flange_end.translation - plan.base_from_flange.translation
    flanges = [from_parts(share * way) * plan.base_from_flange for share in shares]
    cameras = [flange * head.flange_from_camera_at(float(at)) for flange, at in zip(flanges, rail, strict=True)]
    turns, eyes = np.array([pose.rotation for pose in cameras]), np.array([pose.translation for pose in cameras])
    lamps = eyes + turns @ config.laser.exit_point
    # Rays of the laser's fan, a little wider than the picture.
    slopes = 1.1 * np.linspace(-0.5, 0.5, ROWS) * head.camera.height / head.camera.fy
    middle = np.array([1.0 / config.laser.tan_theta, 0.0, 1.0])
    fan = middle + np.outer(slopes, [0.0, 1.0, 0.0])
    fan /= np.linalg.norm(fan, axis=1, keepdims=True)
    ways = np.einsum("lij,rj->lri", turns, fan)
    origins = np.repeat(lamps, ROWS, axis=0)
    triangle, distance = rays.hits(origins, ways.reshape(-1, 3))
    met = np.flatnonzero(triangle >= 0)
    line = met // ROWS
    points = origins[met] + distance[met, None] * ways.reshape(-1, 3)[met]
    normals = rays.smooth_normals(triangle[met], points)
    local = np.einsum("nij,ni->nj", turns[line], points - eyes[line])
    pixels = head.camera.project(local)
    sight = (eyes[line] - points) / np.linalg.norm(eyes[line] - points, axis=1, keepdims=True)
    keep = ((pixels >= 0) & (pixels <= (head.camera.width - 1, head.camera.height - 1))).all(axis=1)
    keep &= (local[:, 2] >= NEAREST) & (local[:, 2] <= FARTHEST)
    keep &= np.einsum("ni,ni->n", normals, sight) > GRAZING
    keep &= -np.einsum("ni,ni->n", normals, ways.reshape(-1, 3)[met]) > GRAZING
    keep[keep] = rays.open_between(points[keep], eyes[line[keep]])
    made = [np.full((count * ROWS, 3), np.nan) for _ in range(3)]
    _, by_pixel = triangulate(head.camera, head.light_plane, pixels[keep])
    spread = STRIPE_PX * np.einsum("nij,nj->ni", turns[line[keep]], by_pixel[:, :, 0])
    for values, into in zip((points[keep], normals[keep], spread), made, strict=True):
        into[met[keep]] = values
    shape = (count, ROWS, 3)
    return SeenSurface(
        made[0].reshape(shape), made[1].reshape(shape), made[2].reshape(shape),
        np.array([flange.homogeneous for flange in flanges]), rail=rail, along=turns[0][:, 0], eyes=eyes, lamps=lamps,
    )  # fmt: skip


def as_cloud(seen: list[SeenSurface], rail_sigma: float) -> Cloud:
    """The sweeps as the cloud that they would make without noise, in the surface frame."""
    lines = [len(each.rail) for each in seen]
    points = np.concatenate([each.points for each in seen])
    return Cloud(
        points=points,
        stripe_spread=np.concatenate([each.spread for each in seen]).astype(np.float32),
        rail_spread=np.concatenate([np.tile(rail_sigma * each.along, (len(each.rail), 1)) for each in seen]),
        centres=np.zeros(points.shape[:2]),
        rail=np.concatenate([each.rail for each in seen]),
        rejected=np.zeros(points.shape[:2], dtype=np.bool_),
        flanges=np.concatenate([each.flanges for each in seen]),
        sweeps=np.repeat(np.arange(len(seen)), lines),
    )

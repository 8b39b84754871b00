"""Stations along an object longer than one swath, joined by the overlaps of their surfaces.

Each station's surface is registered to the one before with the product's pose inversion, from a start as rough as a
vehicle's odometry gives; the poses are chained, so their errors add up along the object.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.geometry.poses import from_parts, perturbed, transform
from cell.inversion import NominalSurface, Prior
from cell.inversion.correspondences import Scan
from cell.inversion.registration import register
from cell.lab.paper.rig import RigSpec, Sweep, TrueHead, sweep
from cell.lab.paper.spoiled import reconstruct
from cell.reconstruction import Cloud, ScanGeometry
from sim_backends.optics import Mesh

Array = NDArray[np.float64]

STATIONS = 4
STEP = 0.5
"""Way from station to station, m."""
START_M, START_RAD = 0.002, 0.002
"""One standard deviation per axis of what is known of a step beforehand."""
PLACED_RAD = 0.01
"""One standard deviation per axis of how crooked a station stands."""
BLOCK = 16
"""Rows that are averaged into one point of the surface that the next station is registered to."""
LINES = 100
RIM = 0.015
MOST_POINTS = 8000


def stitch(
    spec: RigSpec, head: TrueHead, geometry: ScanGeometry, mesh: Mesh, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Points (n, 3) of all stations in the first one's frame, measured and true, m."""
    middle = float(np.mean(spec.depths))
    facing = np.diag([1.0, -1.0, -1.0])
    found, true = [], []
    chain = pin.SE3.Identity()
    before: NominalSurface | None = None
    first_from_object = from_parts((0.5 * spec.travel + 0.5 * STEP * (STATIONS - 1), 0.0, middle), facing)
    standing = pin.SE3.Identity()
    for k in range(STATIONS):
        placed = from_parts((STEP * k, 0.0, 0.0)) if k else standing
        if k:
            placed = perturbed(placed, np.concatenate([np.zeros(3), PLACED_RAD * rng.standard_normal(3)]))
        swept = sweep(spec, head, mesh, placed.inverse() * first_from_object, np.linspace(0.0, spec.travel, LINES), rng)
        cloud = reconstruct(swept, swept.centres, geometry, spec)
        if before is not None:
            step = standing.inverse() * placed
            rough = perturbed(step, np.r_[START_M * rng.standard_normal(3), START_RAD * rng.standard_normal(3)])
            prior = Prior(rough.inverse(), np.diag([START_M**2] * 3 + [START_RAD**2] * 3))
            chain = chain * register(Scan.of(cloud, MOST_POINTS), before, prior).base_from_surface.inverse()
        before, standing = surface_of(cloud), placed
        lines, rows = cloud.subsample(2000)
        found.append(transform(chain, cloud.points[lines, rows]))
        true.append(transform(placed, _truth(swept)[lines, rows]))
    return np.concatenate(found), np.concatenate(true)


def _truth(swept: Sweep) -> Array:
    """The sweep's truth in the order of its cloud, whose lines are sorted by the rail's readings."""
    return np.asarray(swept.truth[np.argsort(swept.readings, kind="stable")], dtype=np.float64)


def surface_of(cloud: Cloud) -> NominalSurface:
    """The cloud as a surface: rows averaged in blocks, then joined line by line; outside is towards the camera."""
    count = cloud.shape[1] // BLOCK
    blocks = cloud.points[:, : count * BLOCK].reshape(cloud.shape[0], count, BLOCK, 3)
    # A block with a hole in it has no mean: NaN.
    points = np.asarray(blocks.mean(axis=2), dtype=np.float64)
    index = np.arange(points.shape[0] * count).reshape(points.shape[0], count)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, c, b]), np.column_stack([a, d, c])])
    vertices = points.reshape(-1, 3)
    kept = faces[np.isfinite(vertices[faces]).all(axis=(1, 2))]
    used, renumbered = np.unique(kept, return_inverse=True)
    return NominalSurface(vertices[used], renumbered.reshape(-1, 3), RIM)

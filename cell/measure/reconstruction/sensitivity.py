"""How the cloud would move if calibration, flange or vehicle were elsewhere, each within its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.reconstruction.cloud import Array, Cloud


def calibration_motions(
    cloud: Cloud,
    lines: NDArray[np.intp],
    rows: NDArray[np.intp],
    base_from_flange: pin.SE3 | None,
    geometry: ScanGeometry,
    variants: Sequence[ScanGeometry],
) -> Array:
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
    sweeps = cloud.sweeps[lines] if len(cloud.sweeps) else np.zeros(len(lines), dtype=np.intp)
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

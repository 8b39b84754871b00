"""How the cloud would move if the calibration were another one within its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.reconstruction.build import ScanGeometry
from cell.reconstruction.cloud import Array, Cloud


def calibration_motions(
    cloud: Cloud,
    lines: NDArray[np.intp],
    rows: NDArray[np.intp],
    base_from_flange: pin.SE3,
    geometry: ScanGeometry,
    variants: Sequence[ScanGeometry],
) -> Array:
    """(n, 3, m) displacements in m, base axes, of the n points at (lines, rows) under each of m other geometries.

    With variants along the columns of a square root of the calibration's covariance, the sum of the outer products of a
    point's displacements is the covariance that the calibration leaves it with.
    """
    pixels = np.column_stack([cloud.centres[lines, rows], rows.astype(np.float64)])
    nominal, _ = geometry.solve(pixels, cloud.rail[lines])
    motions = np.empty((len(lines), 3, len(variants)))
    for k, variant in enumerate(variants):
        points, _ = variant.solve(pixels, cloud.rail[lines])
        motions[:, :, k] = (points - nominal) @ base_from_flange.rotation.T
    return motions

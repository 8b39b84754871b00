"""What each parameter's uncertainty does to a place that is measured: in mm, at the points where it counts.

Parameters are known together better than apart (a shift of the principal point looks like a turn of the camera), so
each has two figures: what its own deviation would do alone, and what is left when it is known exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from cell.measure.calibration.solve.blocks import SHARED, AdjustmentState
from cell.measure.calibration.solve.results import KEPT, PARAMETERS
from cell.measure.geometry.camera import Array
from cell.measure.reconstruction.build import ScanGeometry

GROUPS = {
    "camera": range(9),
    "light plane": range(9, 12),
    "rail": range(12, 15),
    "hand-eye": range(15, 21),
}
UNITS = ("px",) * 4 + ("",) * 5 + ("mrad",) * 2 + ("mm",) + ("",) * 3 + ("mm",) * 3 + ("mrad",) * 3
STEP_SIGMAS = 0.1


@dataclass(frozen=True, eq=False)
class Places:
    """Points as the scan head measures them: stripe pixels (n, 2), rail positions (n,) in m, at one flange pose."""

    pixels: Array
    rails: Array
    base_from_flange: pin.SE3

    def measured(self, state: AdjustmentState) -> Array:
        """Points (n, 3) in the arm's base, m."""
        assert state.plane is not None
        head = ScanGeometry(state.camera, state.plane, state.rail_direction, state.flange_from_camera)
        points = head.solve(self.pixels, self.rails)[0]
        return np.asarray(points @ self.base_from_flange.rotation.T + self.base_from_flange.translation)


def derivatives(state: AdjustmentState, covariance: Array, places: Places) -> Array:
    """∂point/∂parameter (n, 3, 21) in the base, by differences of a tenth of each parameter's deviation."""
    made = np.zeros((len(places.pixels), 3, KEPT))
    still = AdjustmentState(
        state.camera, state.plane, state.rail_direction, state.flange_from_camera, state.base_from_board
    )  # without the views' own
    for k, sigma in enumerate(np.sqrt(np.maximum(np.diag(covariance)[:KEPT], 0.0))):
        if sigma == 0:
            continue
        step = np.zeros(SHARED)
        step[k] = STEP_SIGMAS * sigma
        more, less = places.measured(still.moved(step)), places.measured(still.moved(-step))
        made[:, :, k] = (more - less) / (2 * STEP_SIGMAS * sigma)
    return made


def place_rms(by_parameter: Array, covariance: Array) -> float:
    """RMS over the points, in m, of the displacement that a calibration of this covariance (≥21, ≥21) leaves."""
    known = covariance[:KEPT, :KEPT]
    return float(np.sqrt(np.einsum("nik,kl,nil->", by_parameter, known, by_parameter) / len(by_parameter)))


def influences(by_parameter: Array, covariance: Array) -> dict[str, Any]:
    """`total_mm`, and `parameters` and `groups` sorted by what they do alone, each with `alone_mm` and `if_known_mm`.

    `alone_mm` is the RMS displacement of the points by one deviation with all else exact; `if_known_mm` the total that
    is left when that parameter or group is known exactly. Parameters have their `sigma` and its `unit` too.
    """
    known = covariance[:KEPT, :KEPT]
    sigma = np.sqrt(np.maximum(np.diag(known), 0.0))
    size = np.sqrt(np.mean(np.sum(by_parameter**2, axis=1), axis=0))
    parameters = [
        {
            "name": name,
            "sigma": float(sigma[k] * (1e3 if UNITS[k] in ("mm", "mrad") else 1.0)),
            "unit": UNITS[k],
            "alone_mm": float(1e3 * sigma[k] * size[k]),
            "if_known_mm": 1e3 * place_rms(by_parameter, _given(known, [k])),
        }
        for k, name in enumerate(PARAMETERS)
        if sigma[k] > 0
    ]
    groups = []
    for name, members in GROUPS.items():
        inner = np.zeros_like(known)
        inner[np.ix_(members, members)] = known[np.ix_(members, members)]
        alone, left = place_rms(by_parameter, inner), place_rms(by_parameter, _given(known, list(members)))
        groups.append({"name": name, "alone_mm": 1e3 * alone, "if_known_mm": 1e3 * left})
    return {
        "total_mm": 1e3 * place_rms(by_parameter, known),
        "points": len(by_parameter),
        "parameters": sorted(parameters, key=lambda row: -float(str(row["alone_mm"]))),
        "groups": sorted(groups, key=lambda row: -float(str(row["alone_mm"]))),
    }


def _given(covariance: Array, known: Sequence[int]) -> Array:
    """The covariance of all when some are known exactly."""
    members = np.array([k for k in known if covariance[k, k] > 0], dtype=np.intp)
    if not len(members):
        return covariance
    scale = np.sqrt(np.diag(covariance)[members])
    inner = covariance[np.ix_(members, members)] / scale[:, None] / scale
    mixed = covariance[:, members] / scale
    return np.asarray(covariance - mixed @ np.linalg.solve(inner, mixed.T))

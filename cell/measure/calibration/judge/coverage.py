"""What a calibration's views cover, and what is left over in the pictures: the figures behind its residual maps.

What each parameter's uncertainty does to a place that is measured: in mm, at the points where it counts.

Parameters are known together better than apart (a shift of the principal point looks like a turn of the camera), so
each has two figures: what its own deviation would do alone, and what is left when it is known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.normal import SHARED, AdjustmentState, dots_block, stripe_block
from cell.measure.calibration.solve.results import KEPT, PARAMETERS
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import transform
from cell.measure.reconstruction.build import ScanGeometry

GRID = (8, 6)
"""Cells of the picture, columns and rows."""
LEAST_IN_CELL = 3


@dataclass(frozen=True, eq=False)
class Coverage:
    """Dots: pixels and residuals (n, 2) in px; stripe: pixels (m, 2), residuals (m,) in px across it, depths (m,) in m.

    The stripe's points are means of neighbouring rows, and its residuals are theirs.

    One entry for each view: `depth` (v,) of the board's middle in m, `tilt` (v, 2) of its normal about the picture's
    x and y in rad, `rail` (v,) in m. `size` is that of the picture in px.
    """

    size: tuple[int, int]
    dots: Array
    dots_off: Array
    stripe: Array
    stripe_off: Array
    stripe_depth: Array
    depth: Array
    tilt: Array
    rail: Array

    @classmethod
    def of(cls, joint: Joint) -> Coverage:
        """At the solution of a joint adjustment."""
        state = joint.adjusted.state
        dots, off, stripe, away, reach = [], [], [], [], []
        depth, tilt = [], []
        for view, flange, rail in zip(joint.views, state.flanges, state.rails.tolist(), strict=True):
            pose = state.camera_from_board(flange, rail)
            if len(view.points):
                dots.append(view.pixels)
                off.append(dots_block(state, view, flange, rail)[0])
                depth.append(float(transform(pose, view.points)[:, 2].mean()))
                normal = pose.rotation[:, 2]
                tilt.append((float(np.arctan2(-normal[1], normal[2])), float(np.arctan2(normal[0], normal[2]))))
            if len(view.stripe) and state.plane is not None:
                residual, _, sigma = stripe_block(state, view, flange, rail)
                stripe.append(view.stripe)
                away.append(residual / sigma * view.stripe_sigma)
                reach.append(state.plane.intersect(state.camera.rays(view.stripe))[:, 2])
        return cls(
            (state.camera.width, state.camera.height),
            np.concatenate([np.zeros((0, 2)), *dots]),
            np.concatenate([np.zeros((0, 2)), *off]),
            stripe=np.concatenate([np.zeros((0, 2)), *stripe]),
            stripe_off=np.concatenate([np.zeros(0), *away]),
            stripe_depth=np.concatenate([np.zeros(0), *reach]),
            depth=np.array(depth),
            tilt=np.array(tilt).reshape(-1, 2),
            rail=np.asarray(state.rails),
        )

    def cells(self, pixels: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Column and row (n,) of the cell of `GRID` in which pixels (n, 2) lie."""
        at = (pixels + 0.5) / np.array(self.size) * np.array(GRID)
        return np.clip(at[:, 0], 0, GRID[0] - 1).astype(np.intp), np.clip(at[:, 1], 0, GRID[1] - 1).astype(np.intp)

    def counts(self, pixels: Array) -> Array:
        """Number of points (rows, columns) in each cell."""
        made = np.zeros((GRID[1], GRID[0]))
        columns, rows = self.cells(pixels)
        np.add.at(made, (rows, columns), 1.0)
        return made

    def cell_means(self) -> Array:
        """Mean residual (rows, columns, 2) in px of the dots in each cell; NaN where there are fewer than three."""
        count = self.counts(self.dots)
        total = np.zeros((GRID[1], GRID[0], 2))
        columns, rows = self.cells(self.dots)
        np.add.at(total, (rows, columns), self.dots_off)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(count[..., None] >= LEAST_IN_CELL, total / count[..., None], np.nan)

    def summary(self) -> dict[str, Any]:
        """Figures in px, mm and degrees; the stripe's are None without one."""
        means = np.linalg.norm(self.cell_means(), axis=2)
        lit = len(self.stripe) > 0
        return {
            "views": len(self.depth),
            "dots": len(self.dots),
            "field_covered": float(np.mean(self.counts(self.dots) >= LEAST_IN_CELL)),
            "dots_rms_px": float(np.sqrt(np.mean(self.dots_off**2))),
            "largest_cell_mean_px": float(np.nanmax(means)) if np.isfinite(means).any() else None,
            "depth_mm": _range(1e3 * self.depth),
            "tilt_about_x_deg": _range(np.degrees(self.tilt[:, 0])),
            "tilt_about_y_deg": _range(np.degrees(self.tilt[:, 1])),
            "rail_mm": _range(1e3 * self.rail),
            "stripe_points": len(self.stripe),
            "stripe_rms_px": float(np.sqrt(np.mean(self.stripe_off**2))) if lit else None,
            "stripe_depth_mm": _range(1e3 * self.stripe_depth) if lit else None,
            "stripe_columns_px": _range(self.stripe[:, 0]) if lit else None,
            "stripe_rows_px": _range(self.stripe[:, 1]) if lit else None,
        }


def _range(values: Array) -> list[float]:
    return [float(values.min()), float(values.max())]


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


def influences(by_parameter: Array, covariance: Array) -> dict[str, object]:
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

"""A head calibrated three ways, and how far each puts the points of a sweep from the truth.

`nominal` is the drawing, `staged` the paper's steps one after the other, `joint` the adjustment of everything together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.calibration import ScanCalibration, ScanObservation
from cell.measure.calibration.solve.joint import solve_joint, solve_staged
from cell.measure.calibration.solve.results import KEPT, Quality
from cell.measure.reconstruction import ScanGeometry
from lab.paper.rig import RigSpec

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

DIRECTIONS = 300
"""Directions, evenly over the sphere, over which the mean length of a Gaussian error is taken."""


@dataclass(frozen=True, eq=False)
class Solved:
    """The three geometries and the calibration of the joint one, which carries the covariance."""

    nominal: ScanGeometry
    staged: ScanGeometry
    joint: ScanGeometry
    calibration: ScanCalibration

    def ways(self) -> dict[str, ScanGeometry]:
        """By name, in the order of a table."""
        return {"nominal": self.nominal, "staged": self.staged, "joint": self.joint}


def solve(spec: RigSpec, observations: list[ScanObservation]) -> Solved:
    """Calibrate with the product's own estimators."""
    staged = solve_staged(observations, spec.nominal_camera(), np.array([1.0, 0.0, 0.0]))
    joint = solve_joint(observations, staged, spec.noise.priors, held_out=False)
    state = joint.adjusted.state
    assert staged.plane is not None and state.plane is not None
    hand = staged.hand_eye
    calibration = ScanCalibration(
        state.camera, state.plane, state.rail_direction, state.flange_from_camera,
        joint.adjusted.covariance[:KEPT, :KEPT], Quality.of(joint),
    )  # fmt: skip
    return Solved(
        spec.nominal(),
        ScanGeometry(staged.camera, staged.plane.plane, hand.rail_direction, hand.flange_from_camera),
        calibration.geometry(),
        calibration,
    )


def in_scan_frame(geometry: ScanGeometry) -> ScanGeometry:
    """The same head without its mount: its points are in the camera's frame at rail position 0."""
    return ScanGeometry(geometry.camera, geometry.light_plane, geometry.rail_direction, pin.SE3.Identity())


def expected_length(covariances: Array) -> float:
    """Mean over points of the mean length in m of a Gaussian error with each of the `covariances` (n, 3, 3) in m².

    A standard normal vector is a length of mean √(8/π) times an independent direction u, so E‖A g‖ = √(8/π) E‖A u‖.
    """
    k = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - 2 * k / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - height**2)
    directions = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    squares = np.einsum("di,nij,dj->nd", directions, covariances, directions)
    return float(np.sqrt(8 / np.pi) * np.sqrt(np.maximum(squares, 0.0)).mean())


def point_covariances(
    spec: RigSpec, geometry: ScanGeometry, variants: list[ScanGeometry], pixels: Array, rail: Array
) -> Array:
    """Covariances (n, 3, 3) in m² of points from calibration, stripe and rail noise, in the geometry's own frame."""
    points, by_pixel = geometry.solve(pixels, rail)
    spread = [variant.solve(pixels, rail)[0] - points for variant in variants]
    along = np.broadcast_to(geometry.flange_from_camera.rotation @ geometry.rail_direction, points.shape)
    columns = np.stack([*spread, by_pixel[:, :, 0] * spec.noise.stripe, along * spec.noise.rail], axis=2)
    return np.asarray(columns @ columns.transpose(0, 2, 1))


def aligned(found: Array, truth: Array) -> Array:
    """What is left (n, 3) of found − truth after the best rigid motion of the found points (Kabsch)."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    return np.asarray(a @ (u @ turn @ vt) - b, dtype=np.float64)

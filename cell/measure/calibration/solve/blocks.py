"""Residuals of one view of a calibration, with their analytic derivatives: the dots in px, the stripe in m.

Columns of every Jacobian: camera (9), light plane (3: two turns of the normal, distance), rail (3), hand-eye (6),
board (6), then the view's own flange pose (6) and rail position (1). Poses move as in `cell.measure.geometry.poses`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.board_projection import dots_terms
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import cross, from_parts, perturbed

CAMERA, PLANE, RAIL = slice(0, 9), slice(9, 12), slice(12, 15)
HAND, BOARD = slice(15, 21), slice(21, 27)
SHARED = 27
FLANGE, POSITION = slice(27, 33), slice(33, 34)
OWN = 7
COLUMNS = SHARED + OWN


@dataclass(frozen=True, eq=False)
class ViewData:
    """Measurements of one view: board points (n, 3) in m, their pixels (n, 2) and σ (n,), stripe pixels on the board.

    `base_from_flange` and `rail` are as reported; `dot_radius` in m, 0 for corners. Empty arrays where nothing is seen.
    The stripe was measured along `stripe_axis` (0: along rows, its column has the noise; 1: along columns).
    `same_rest` says that the flange stands exactly where it stood in the view before, wherever that was.
    """

    points: Array
    pixels: Array
    sigma: Array
    dot_radius: float
    stripe: Array
    stripe_sigma: Array
    base_from_flange: pin.SE3
    rail: float
    stripe_axis: int = 0
    same_rest: bool = False


def rests_of(views: Sequence[ViewData]) -> NDArray[np.intp]:
    """The number (n,) of the rest of the arm in which each view was taken, from 0."""
    new = np.array([k == 0 or not view.same_rest for k, view in enumerate(views)], dtype=np.bool_)
    return np.asarray(np.cumsum(new) - 1, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class AdjustmentState:
    """Everything that the adjustment estimates. `rail_direction` (3,): camera travel per metre of rail reading."""

    camera: CameraModel
    plane: LightPlane | None
    rail_direction: Array
    flange_from_camera: pin.SE3
    base_from_board: pin.SE3
    flanges: list[pin.SE3] = field(default_factory=list)
    rails: Array = field(default_factory=lambda: np.zeros(0))

    def moved(self, step: Array) -> AdjustmentState:
        """The state after a step (27 + 7 per view,)."""
        plane = self.plane
        if plane is not None:
            a, b = tangents(plane.n)
            turned = LightPlane.of(plane.n + step[9] * a + step[10] * b, 1.0)
            plane = replace(plane, normal=turned.normal, distance=plane.distance + float(step[11]))
        own = step[SHARED:].reshape(-1, OWN)
        return AdjustmentState(
            self.camera.with_parameters(self.camera.parameters + step[CAMERA]),
            plane,
            self.rail_direction + step[RAIL],
            flange_from_camera=perturbed(self.flange_from_camera, step[HAND]),
            base_from_board=perturbed(self.base_from_board, step[BOARD]),
            flanges=[perturbed(pose, d[:6]) for pose, d in zip(self.flanges, own, strict=True)],
            rails=self.rails + own[:, 6],
        )

    def camera_from_board(self, flange: pin.SE3, rail: float) -> pin.SE3:
        """Pose of the board in the camera at a flange pose and a rail position."""
        base_from_camera = flange * self.flange_from_camera * from_parts(rail * self.rail_direction)
        return base_from_camera.inverse() * self.base_from_board


def tangents(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors perpendicular to a unit normal and to each other."""
    other = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = cross(normal, other)
    first /= np.linalg.norm(first)
    return first, cross(normal, first)


def dots_block(state: AdjustmentState, view: ViewData, flange: pin.SE3, rail: float) -> tuple[Array, Array]:
    """Measured minus predicted pixels (n, 2), and the derivative of the prediction (n, 2, COLUMNS)."""
    hand, board = state.flange_from_camera, state.base_from_board
    pixels, jacobian = np.empty(view.pixels.shape), np.empty((len(view.points), 2, COLUMNS))
    dots_terms(
        state.camera.parameters,
        board.rotation,
        flange.rotation,
        hand=hand.rotation,
        places=np.array([board.translation, flange.translation, hand.translation]),
        rail=float(rail),
        travel=np.ascontiguousarray(state.rail_direction, dtype=np.float64),
        points=np.ascontiguousarray(view.points),
        radius=float(view.dot_radius),
        pixels=pixels,
        jacobian=jacobian,
    )
    return view.pixels - pixels, jacobian


def stripe_block(state: AdjustmentState, view: ViewData, flange: pin.SE3, rail: float) -> tuple[Array, Array, Array]:
    """Negative distance (m,) of the stripe points from the board's plane, derivative of the distance, σ (m,).

    All in m. The sign makes the block like that of the dots, where the residual is measured minus predicted.
    """
    assert state.plane is not None
    camera, plane, hand, board = state.camera, state.plane, state.flange_from_camera, state.base_from_board
    rays, ray_by_pixel = camera.rays_with_jacobian(view.stripe)
    points, by_ray, by_normal, by_distance = plane.intersect_with_jacobians(rays)
    # A change of the camera's parameters moves a fixed pixel's ray as the opposite move of the pixel would.
    by_camera = camera.parameter_jacobian(rays)
    point_by_pixel = by_ray @ ray_by_pixel
    moved = points + rail * state.rail_direction
    turned = moved @ hand.rotation.T
    in_flange = turned + hand.translation
    swung = in_flange @ flange.rotation.T
    in_base = swung + flange.translation
    normal = board.rotation[:, 2]
    normal_flange = flange.rotation.T @ normal
    normal_camera = hand.rotation.T @ normal_flange
    away = in_base - board.translation
    distance = away @ normal
    a, b = tangents(plane.n)
    jacobian = np.zeros((len(points), COLUMNS))
    by_pixel = normal_camera @ point_by_pixel
    jacobian[:, CAMERA] = -np.einsum("ni,nij->nj", by_pixel, by_camera)
    by_n = normal_camera @ by_normal
    jacobian[:, 9], jacobian[:, 10] = by_n @ a, by_n @ b
    jacobian[:, 11] = by_distance @ normal_camera
    jacobian[:, RAIL] = rail * normal_camera
    jacobian[:, 15:18] = normal_flange
    jacobian[:, 18:21] = cross(turned, normal_flange)
    jacobian[:, 21:24] = -normal
    jacobian[:, 24:27] = cross(normal, away)
    jacobian[:, 27:30] = normal
    jacobian[:, 30:33] = cross(swung, normal)
    jacobian[:, 33] = normal_camera @ state.rail_direction
    sigma = np.abs(by_pixel[:, view.stripe_axis]) * view.stripe_sigma
    return -distance, jacobian, np.maximum(sigma, 1e-7)

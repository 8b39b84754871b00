"""Residuals of one view with their derivatives, and normal equations in the shape of the joint adjustment.

Columns of every Jacobian: camera (9), light plane (3: two turns of the normal, distance), rail (3), hand-eye (6),
board (6), then the view's own flange pose (6) and rail position (1). Poses move as in `cell.measure.geometry.poses`.
Rests of the arm touch each other only through the shared parameters, so their own are eliminated rest by rest (Schur
complement): the work grows with the number of views, not its cube.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.board_projection import dots_terms
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import cross, from_parts, perturbed
from drivers.errors import RefusedError

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
    base_from_flange: pin.SE3
    rail: float = 0.0
    stripe: Array = field(default_factory=lambda: np.zeros((0, 2)))
    stripe_sigma: Array = field(default_factory=lambda: np.zeros(0))
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

    def moved(self, step: Array) -> "AdjustmentState":
        """The state after a step (27 + 7 per view,)."""
        plane = self.plane
        if plane is not None:
            a, b = tangents(plane.n)
            turned = LightPlane.of(plane.n + step[9] * a + step[10] * b, 1.0)
            plane = replace(plane, normal=turned.normal, distance=plane.distance + float(step[11]))
        own = step[SHARED:].reshape(-1, OWN)
        return AdjustmentState(
            self.camera.with_parameters(self.camera.parameters + step[CAMERA]), plane, self.rail_direction + step[RAIL],
            flange_from_camera=perturbed(self.flange_from_camera, step[HAND]),
            base_from_board=perturbed(self.base_from_board, step[BOARD]),
            flanges=[perturbed(pose, d[:6]) for pose, d in zip(self.flanges, own, strict=True)],
            rails=self.rails + own[:, 6],
        )  # fmt: skip

    def camera_from_board(self, flange: pin.SE3, rail: float) -> pin.SE3:
        """Pose of the board in the camera at a flange pose and a rail position."""
        base_from_camera = flange * self.flange_from_camera * from_parts(rail * self.rail_direction)
        return base_from_camera.inverse() * self.base_from_board


def tangents(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors perpendicular to a unit normal and to each other."""
    first = cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    return first, cross(normal, first)


def dots_block(state: AdjustmentState, view: ViewData, flange: pin.SE3, rail: float) -> tuple[Array, Array]:
    """Measured minus predicted pixels (n, 2), and the derivative of the prediction (n, 2, COLUMNS)."""
    hand, board = state.flange_from_camera, state.base_from_board
    pixels, jacobian = np.empty(view.pixels.shape), np.empty((len(view.points), 2, COLUMNS))
    dots_terms(
        state.camera.parameters, board.rotation, flange.rotation, hand=hand.rotation,
        places=np.array([board.translation, flange.translation, hand.translation]), rail=float(rail),
        travel=np.ascontiguousarray(state.rail_direction, dtype=np.float64), points=np.ascontiguousarray(view.points),
        radius=float(view.dot_radius), pixels=pixels, jacobian=jacobian,
    )  # fmt: skip
    return view.pixels - pixels, jacobian


def stripe_block(state: AdjustmentState, view: ViewData, flange: pin.SE3, rail: float) -> tuple[Array, Array, Array]:
    """Negative distance (m,) of the stripe points from the board's plane, derivative of the distance, σ (m,). All in m.
    The sign makes the block like that of the dots, where the residual is measured minus predicted."""
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


GROUPS = ("dots", "stripe", "shift", "turn", "rail", "lens")


@dataclass(eq=False)
class Block:
    """Information of a group of measurements: shared (27, 27), and by view shared by own (n, 27, 7), own (n, 7, 7)."""

    shared: Array
    cross: Array
    own: Array
    squares: float = 0.0
    count: float = 0.0


@dataclass(eq=False)
class Inverse:
    """The same blocks of the covariance; fixed parameters have zeros. Views of one rest repeat its flange's."""

    shared: Array
    cross: Array
    own: Array

    def taken(self, block: Block) -> float:
        """Degrees of freedom that the parameters take from a group: the trace of covariance times information."""
        own = np.sum(self.own * block.own) + 2 * np.sum(self.cross * block.cross)
        return float(np.sum(self.shared * block.shared) + own)


class Normal:
    """Accumulates groups of whitened Jacobians and residuals, then solves."""

    def __init__(self, rests: NDArray[np.intp], free: NDArray[np.bool_], own_free: NDArray[np.bool_]) -> None:
        """`rests` (views,) numbers the rest of the arm in which each view was taken; free ones of (27,) and (7,) move.
        Views of one rest have one flange pose in common; each has a rail position of its own."""
        views = len(rests)
        self.groups = {
            name: Block(np.zeros((SHARED, SHARED)), np.zeros((views, SHARED, OWN)), np.zeros((views, OWN, OWN)))
            for name in GROUPS
        }
        self.right = np.zeros(SHARED)
        self.right_own = np.zeros((views, OWN))
        self._free, self._own_free = np.flatnonzero(free), np.flatnonzero(own_free)
        self._views, self._rests = views, rests
        # Where a view's free own parameters stand among its rest's: the flange's first, then a rail for each view.
        turn = np.array([np.count_nonzero(rests[:k] == rest) for k, rest in enumerate(rests)], dtype=np.intp)
        self._places = np.tile(self._own_free, (views, 1))
        self._places[:, self._own_free == OWN - 1] += turn[:, None]

    @property
    def total(self) -> float:
        """The robust sum of squares."""
        return float(sum(block.squares for block in self.groups.values()))

    def add_view(self, name: str, view: int, jacobian: Array, residual: Array, cost: float, share: float = 1.0) -> None:
        """Rows (m, 34) of one view, whitened, with their whitened residuals (m,), a share of which is independent."""
        block = self.groups[name]
        shared, own = jacobian[:, :SHARED], jacobian[:, SHARED:]
        block.shared += shared.T @ shared
        block.cross[view] += shared.T @ own
        block.own[view] += own.T @ own
        self.right += shared.T @ residual
        self.right_own[view] += own.T @ residual
        block.squares += cost
        block.count += share * len(residual)

    def add_prior(self, name: str, view: int, first: int, white: Array, deviation: float) -> None:
        """Whitened departures (m,) of a view's own parameters from `first` on, each with one standard deviation."""
        index = np.arange(first, first + len(white))
        self.groups[name].own[view, index, index] += 1 / deviation**2
        self.right_own[view, index] += white / deviation
        self._count(name, white)

    def add_shared_rows(self, name: str, rows: Array, residual: Array) -> None:
        """Whitened rows (m, 27) on the shared parameters alone, with their whitened residuals (m,)."""
        self.groups[name].shared += rows.T @ rows
        self.right += rows.T @ residual
        self._count(name, residual)

    def step(self, damping: float) -> Array:
        """The damped step (27 + 7 per view,); views of one rest have the flange's in common."""
        shared, cross, own, right, right_own = self._free_parts()
        # In units in which the information's diagonal is 1.
        a = 1 / np.sqrt(np.maximum(np.diag(shared), 1e-30))
        b = 1 / np.sqrt(np.maximum(np.einsum("kii->ki", own), 1e-30))
        shared = shared * a[:, None] * a + damping * np.eye(len(a))
        cross = cross * a[None, :, None] * b[:, None, :]
        own = own * b[:, :, None] * b[:, None, :] + damping * np.eye(b.shape[1])
        right, right_own = right * a, right_own * b
        eliminated = np.linalg.solve(own, np.concatenate([cross.transpose(0, 2, 1), right_own[:, :, None]], axis=2))
        reduced = shared - np.einsum("kij,kjl->il", cross, eliminated[:, :, :-1])
        shared_step = np.linalg.solve(reduced, right - np.einsum("kij,kj->i", cross, eliminated[:, :, -1]))
        own_step = eliminated[:, :, -1] - eliminated[:, :, :-1] @ shared_step
        step, own_all = np.zeros(SHARED), np.zeros((self._views, OWN))
        step[self._free] = shared_step * a
        own_all[:, self._own_free] = (own_step * b)[self._rests[:, None], self._places]
        return np.concatenate([step, own_all.ravel()])

    def promised(self, step: Array) -> float:
        """By how much a Gauss–Newton step (27 + 7 per view,) lowers the sum of squares if the problem is linear."""
        return float(self.right @ step[:SHARED] + self.right_own.ravel() @ step[SHARED:])

    def inverse(self) -> Inverse:
        """Covariance blocks at the solution."""
        shared, cross, own, _, _ = self._free_parts()
        own_inverse = np.linalg.inv(own)
        gain = cross @ own_inverse
        reduced = shared - np.einsum("kij,klj->il", gain, cross)
        if not (np.diag(reduced) > 0).all():
            raise RefusedError(
                "the views leave a part of what is looked for open, or contradict each other: see that all poses are "
                "of one set-up and in one unit, and take more of them, turned to several sides"
            )
        scale = 1 / np.sqrt(np.diag(reduced))
        covariance = np.linalg.inv(reduced * scale[:, None] * scale) * scale[:, None] * scale
        result = Inverse(
            np.zeros((SHARED, SHARED)), np.zeros((self._views, SHARED, OWN)), np.zeros((self._views, OWN, OWN))
        )
        mixed = -covariance @ gain
        inner = own_inverse - gain.transpose(0, 2, 1) @ mixed
        views, rests, places = np.arange(self._views), self._rests[:, None, None], self._places
        result.shared[np.ix_(self._free, self._free)] = covariance
        result.cross[np.ix_(views, self._free, self._own_free)] = mixed[
            rests, np.arange(len(self._free))[:, None], places[:, None, :]
        ]
        result.own[np.ix_(views, self._own_free, self._own_free)] = inner[rests, places[:, :, None], places[:, None, :]]
        return result

    def _free_parts(self) -> tuple[Array, Array, Array, Array, Array]:
        """Of the free parameters: shared, shared by own of each rest, own of each rest, and both right sides."""
        free, own_free, views = self._free, self._own_free, np.arange(self._views)
        blocks = self.groups.values()
        shared = np.sum([b.shared for b in blocks], axis=0)[np.ix_(free, free)]
        cross = np.sum([b.cross for b in blocks], axis=0)[np.ix_(views, free, own_free)]
        own = np.sum([b.own for b in blocks], axis=0)[np.ix_(views, own_free, own_free)]
        count, width = int(self._rests.max()) + 1, int(self._places.max()) + 1
        rests, places = self._rests[:, None], self._places
        by_rest, right = np.zeros((count, width, len(free))), np.zeros((count, width))
        inner = np.zeros((count, width, width))
        np.add.at(by_rest, (rests, places), cross.transpose(0, 2, 1))
        np.add.at(inner, (rests[:, :, None], places[:, :, None], places[:, None, :]), own)
        np.add.at(right, (rests, places), self.right_own[:, own_free])
        # A rest of fewer views than another has fewer rail positions: those that do not exist stay where they are.
        missing = np.ones((count, width), dtype=np.bool_)
        missing[rests, places] = False
        inner[np.nonzero(missing)[0], np.nonzero(missing)[1], np.nonzero(missing)[1]] = 1.0
        return shared, by_rest.transpose(0, 2, 1), inner, self.right[free], right

    def _count(self, name: str, white: Array) -> None:
        self.groups[name].squares += float(white @ white)
        self.groups[name].count += len(white)

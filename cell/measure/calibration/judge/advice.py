"""What would make a calibration better: further views, or less noise, tried on the adjustment's own information.

Nothing is guessed: each candidate's views are put into the normal equations at the solution, and the covariance that
would result is taken to the points where it counts. Whether the arm reaches a view is not asked here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin

from cell.measure.calibration.judge.coverage import Coverage
from cell.measure.calibration.solve.adjustment import Adjustment, Priors, shared_mask
from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.normal import AdjustmentState, ViewData
from cell.measure.geometry.camera import Array, seen_centres
from cell.measure.geometry.poses import from_parts, transform
from cell.measure.vision.board.view import BoardSpec

STEEP = np.deg2rad(28.0)
SLIGHT = np.deg2rad(12.0)
FURTHER = 0.006
EDGE_PX = 12
MARGIN_PITCHES = 0.8


def advice(
    joint: Joint, board: BoardSpec, rail_travel: tuple[float, float], place_rms: Callable[[Array], float]
) -> list[dict[str, object]]:
    """Candidates, best first: `what` to do, the total in mm that would result (`then_mm`), and the `gain` as a share.

    `place_rms` takes a covariance (27, 27) to m. Four views each, so that the gains compare; `kind` is "views", or
    "noise" for what another device or a longer exposure would have to bring.
    """
    now = place_rms(joint.adjusted.reliable_covariance)
    rows = []
    for what, views in _more_views(joint, board, rail_travel).items():
        covariance = _predicted(joint, views, joint.adjusted.priors)
        rows.append({"what": what, "kind": "views", "then_mm": 1e3 * place_rms(covariance)})
    for what, priors in _less_noise(joint.adjusted.priors).items():
        rows.append({"what": what, "kind": "noise", "then_mm": 1e3 * place_rms(_predicted(joint, [], priors))})
    for row in rows:
        row["gain"] = 1 - float(str(row["then_mm"])) / (1e3 * now)
    return sorted(rows, key=lambda row: -float(str(row["gain"])))


def _predicted(joint: Joint, more: list[ViewData], priors: Priors) -> Array:
    """Covariance (27, 27) of the shared parameters with further views, as the information at the solution says it."""
    state = joint.adjusted.state
    rail = float(np.ptp([view.rail for view in joint.views])) > 1e-3
    free = shared_mask(plane=state.plane is not None, rail=rail)
    wider = replace(
        state,
        flanges=[*state.flanges, *(view.base_from_flange for view in more)],
        rails=np.append(state.rails, [view.rail for view in more]),
    )
    normal = Adjustment([*joint.views, *more], free, priors).normal_at(wider)
    return np.asarray(normal.inverse().shared * joint.adjusted.inflation**2)


def _more_views(joint: Joint, board: BoardSpec, travel: tuple[float, float]) -> dict[str, list[ViewData]]:
    state, seen = joint.adjusted.state, Coverage.of(joint)
    near, far, middle = float(seen.depth.min()), float(seen.depth.max()), float(seen.depth.mean())
    low, high = travel
    between = np.linspace(low, high, 6)[1:5]
    field = 0.2 * middle * np.array(seen.size) / state.camera.fx

    def made(poses: list[tuple[Array, Array]], rails: Array) -> list[ViewData]:
        return [_view(joint, board, at, turn, float(s)) for (at, turn), s in zip(poses, rails, strict=True)]

    def square(x: float, y: float, z: float, rx: float = 0.0, ry: float = 0.0, rz: float = 0.0) -> tuple[Array, Array]:
        return np.array([x, y, z]), np.array([rx, ry, rz])

    diagonal = [(SLIGHT, SLIGHT), (-SLIGHT, SLIGHT), (SLIGHT, -SLIGHT), (-SLIGHT, -SLIGHT)]
    corners = [(-field[0], -field[1]), (field[0], -field[1]), (-field[0], field[1]), (field[0], field[1])]
    alone = [replace(view, same_rest=False) for view in joint.views]
    several = np.linspace(0, len(alone) - 1, 4).astype(int)
    ends = f"{1e3 * low:.0f} and {1e3 * high:.0f} mm"
    return {
        "four more views, tilted steeply about the picture's x": made(
            [square(0, 0, middle, rx=side) for side in (STEEP, -STEEP, STEEP, -STEEP)], between
        ),
        "four more views, tilted steeply about the picture's y": made(
            [square(0, 0, middle, ry=side) for side in (STEEP, -STEEP, STEEP, -STEEP)], between
        ),
        f"four more views at the ends of the rail's travel, {ends}": made(
            [square(0, 0, middle, rx, ry) for rx, ry in diagonal], np.array([low, low, high, high])
        ),
        f"four more views from {1e3 * (near - FURTHER):.0f} and {1e3 * (far + FURTHER):.0f} mm": made(
            [
                square(0, 0, z, rx, ry)
                for z, (rx, ry) in zip((near - FURTHER, far + FURTHER) * 2, diagonal, strict=True)
            ],
            between,
        ),
        "four more views with the board in the picture's corners": made(
            [square(x, y, middle, rx, ry) for (x, y), (rx, ry) in zip(corners, diagonal, strict=True)], between
        ),
        "four more views, turned about the optical axis by 90 and 180 deg": made(
            [
                square(0, 0, middle, rx=rx, ry=ry, rz=rz)
                for rz, (rx, ry) in zip((np.pi / 2, -np.pi / 2, np.pi, np.pi), diagonal, strict=True)
            ],
            between,
        ),
        "four of the present views once more": [alone[k] for k in several],
        "all present views once more": list(joint.views),
    }


def _less_noise(priors: Priors) -> dict[str, Priors]:
    """The same views with half of one noise."""
    return {
        "half the noise of the dots": replace(priors, dots_scale=priors.dots_scale / 2),
        "half the noise of the stripe": replace(priors, stripe_scale=priors.stripe_scale / 2),
        "half the noise of the rail's reading": replace(priors, rail=priors.rail / 2),
        "an arm that repeats twice as well": replace(
            priors, arm_translation=priors.arm_translation / 2, arm_rotation=priors.arm_rotation / 2
        ),
    }


def _view(joint: Joint, board: BoardSpec, at: Array, turn: Array, rail: float) -> ViewData:
    """A view as it would be, the board's middle at `at` (3,) in m in the camera, turned by (rx, ry, rz) in rad."""
    state = joint.adjusted.state
    rotation = pin.rpy.rpyToMatrix(*turn)
    camera_from_board = from_parts(at - rotation @ np.array(board.centre), rotation)
    flange_from_camera = state.flange_from_camera * from_parts(rail * state.rail_direction)
    flange = state.base_from_board * (flange_from_camera * camera_from_board).inverse()
    radius = joint.views[0].dot_radius
    points = board.points()
    seen = transform(camera_from_board, points)
    pixels = state.camera.project(seen_centres(seen, rotation[:, 2], radius) if radius > 0 else seen)
    inside = _inside(state, pixels)
    lit = [view for view in joint.views if len(view.stripe)]
    stripe = _stripe(state, board, camera_from_board, radius, int(np.median([len(view.stripe) for view in lit])))
    sigma = float(np.median(np.concatenate([view.sigma for view in joint.views])))
    stripe_sigma = float(np.median(np.concatenate([view.stripe_sigma for view in lit])))
    return ViewData(
        points[inside],
        pixels[inside],
        np.full(int(inside.sum()), sigma),
        dot_radius=radius,
        stripe=stripe,
        stripe_sigma=np.full(len(stripe), stripe_sigma),
        base_from_flange=flange,
        rail=rail,
        stripe_axis=lit[0].stripe_axis,
    )


def _stripe(state: AdjustmentState, board: BoardSpec, camera_from_board: pin.SE3, radius: float, count: int) -> Array:
    """Pixels (n, 2), at most `count`, where light plane and board meet, in the picture and clear of the dots."""
    assert state.plane is not None
    normal = camera_from_board.rotation[:, 2]
    middle = transform(camera_from_board, np.array(board.centre))
    along = np.cross(state.plane.n, normal)
    along /= np.linalg.norm(along)
    system = np.array([state.plane.n, normal, along])
    start = np.linalg.solve(system, np.array([state.plane.distance, normal @ middle, along @ middle]))
    points = board.points()[:, :2]
    low, high = points.min(axis=0) - MARGIN_PITCHES * board.pitch, points.max(axis=0) + MARGIN_PITCHES * board.pitch
    reach = float(np.linalg.norm(high - low)) / 2
    line = start + np.linspace(-reach, reach, 4 * count)[:, None] * along
    local = (line - camera_from_board.translation) @ camera_from_board.rotation[:, :2]
    clear = np.linalg.norm(local[:, None] - points, axis=2).min(axis=1) > 1.3 * radius
    pixels = state.camera.project(line)
    there = ((local > low) & (local < high)).all(axis=1) & clear & _inside(state, pixels)
    chosen = np.flatnonzero(there)
    thin = chosen[np.linspace(0, len(chosen) - 1, min(count, len(chosen))).astype(int)] if len(chosen) else chosen
    return np.asarray(pixels[thin], dtype=np.float64)


def _inside(state: AdjustmentState, pixels: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    camera = state.camera
    return np.asarray(
        ((pixels > EDGE_PX) & (pixels < (camera.width - EDGE_PX, camera.height - EDGE_PX))).all(axis=1), dtype=np.bool_
    )

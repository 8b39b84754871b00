"""What a calibration's views cover, what its uncertainty does to a place, and what would make it better.

Parameters are known together better than apart (a shift of the principal point looks like a turn of the camera), so
each has two figures: what its own deviation does alone, and what is left when it is known exactly. Advice is reckoned
from the adjustment's own information; whether the arm reaches a view is not asked.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from cell.measure.calibration.solve.adjustment import Adjustment, Priors, shared_mask
from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.normal import SHARED, AdjustmentState, ViewData, dots_block, stripe_block
from cell.measure.calibration.solve.results import KEPT, PARAMETERS
from cell.measure.geometry.camera import Array, seen_centres
from cell.measure.geometry.poses import from_parts, transform
from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.vision.board.view import BoardSpec, centre_of

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
    def of(cls, joint: Joint) -> Self:
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
            (state.camera.width, state.camera.height), np.concatenate([np.zeros((0, 2)), *dots]),
            np.concatenate([np.zeros((0, 2)), *off]), stripe=np.concatenate([np.zeros((0, 2)), *stripe]),
            stripe_off=np.concatenate([np.zeros(0), *away]), stripe_depth=np.concatenate([np.zeros(0), *reach]),
            depth=np.array(depth), tilt=np.array(tilt).reshape(-1, 2), rail=np.asarray(state.rails),
        )  # fmt: skip

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
            "views": len(self.depth), "dots": len(self.dots),
            "field_covered": float(np.mean(self.counts(self.dots) >= LEAST_IN_CELL)),
            "dots_rms_px": float(np.sqrt(np.mean(self.dots_off**2))),
            "largest_cell_mean_px": float(np.nanmax(means)) if np.isfinite(means).any() else None,
            "depth_mm": _range(1e3 * self.depth), "tilt_about_x_deg": _range(np.degrees(self.tilt[:, 0])),
            "tilt_about_y_deg": _range(np.degrees(self.tilt[:, 1])), "rail_mm": _range(1e3 * self.rail),
            "stripe_points": len(self.stripe),
            "stripe_rms_px": float(np.sqrt(np.mean(self.stripe_off**2))) if lit else None,
            "stripe_depth_mm": _range(1e3 * self.stripe_depth) if lit else None,
            "stripe_columns_px": _range(self.stripe[:, 0]) if lit else None,
            "stripe_rows_px": _range(self.stripe[:, 1]) if lit else None,
        }  # fmt: skip


def _range(values: Array) -> list[float]:
    return [float(values.min()), float(values.max())]


GROUPS = {"camera": range(9), "light plane": range(9, 12), "rail": range(12, 15), "hand-eye": range(15, 21)}
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
    still = replace(state, flanges=[], rails=np.zeros(0))
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
    members = np.array([k for k in known if covariance[k, k] > 0], dtype=np.intp)
    if not len(members):
        return covariance
    scale = np.sqrt(np.diag(covariance)[members])
    inner = covariance[np.ix_(members, members)] / scale[:, None] / scale
    mixed = covariance[:, members] / scale
    return np.asarray(covariance - mixed @ np.linalg.solve(inner, mixed.T))


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
        state, flanges=[*state.flanges, *(view.base_from_flange for view in more)],
        rails=np.append(state.rails, [view.rail for view in more]),
    )  # fmt: skip
    normal = Adjustment([*joint.views, *more], free, priors).normal_at(wider)
    return np.asarray(normal.inverse().shared * joint.adjusted.inflation**2)


def _more_views(joint: Joint, board: BoardSpec, travel: tuple[float, float]) -> dict[str, list[ViewData]]:
    state, seen = joint.adjusted.state, Coverage.of(joint)
    near, far, middle = float(seen.depth.min()), float(seen.depth.max()), float(seen.depth.mean())
    low, high = travel
    between = np.linspace(low, high, 6)[1:5]
    aside, up = 0.2 * middle * np.array(seen.size) / state.camera.fx
    diagonal = np.array([(SLIGHT, SLIGHT), (-SLIGHT, SLIGHT), (SLIGHT, -SLIGHT), (-SLIGHT, -SLIGHT)])
    steep = np.array([STEEP, -STEEP, STEEP, -STEEP])
    closer, farther = near - FURTHER, far + FURTHER

    def made(rails: Array = between, **at: ArrayLike) -> list[ViewData]:
        """Four views with the board square at `middle` but for what is given: x, y, z in m, rx, ry, rz in rad."""
        poses = np.zeros((4, 6))
        poses[:, 2] = middle
        for name, values in at.items():
            poses[:, ("x", "y", "z", "rx", "ry", "rz").index(name)] = values
        return [_view(joint, board, pose[:3], pose[3:], float(s)) for pose, s in zip(poses, rails, strict=True)]

    slight = {"rx": diagonal[:, 0], "ry": diagonal[:, 1]}
    alone = [replace(view, same_rest=False) for view in joint.views]
    return {
        "four more views, tilted steeply about the picture's x": made(rx=steep),
        "four more views, tilted steeply about the picture's y": made(ry=steep),
        f"four more views at the ends of the rail's travel, {1e3 * low:.0f} and {1e3 * high:.0f} mm": made(
            np.array([low, low, high, high]), **slight
        ),
        f"four more views from {1e3 * closer:.0f} and {1e3 * farther:.0f} mm": made(z=[closer, farther] * 2, **slight),
        "four more views with the board in the picture's corners": made(
            x=[-aside, aside, -aside, aside], y=[-up, -up, up, up], **slight
        ),
        "four more views, turned about the optical axis by 90 and 180 deg": made(
            rz=[np.pi / 2, -np.pi / 2, np.pi, np.pi], **slight
        ),
        "four of the present views once more": [alone[k] for k in np.linspace(0, len(alone) - 1, 4).astype(int)],
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
    camera_from_board = from_parts(at - rotation @ centre_of(board), rotation)
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
        points[inside], pixels[inside], np.full(int(inside.sum()), sigma), dot_radius=radius, stripe=stripe,
        stripe_sigma=np.full(len(stripe), stripe_sigma), base_from_flange=flange, rail=rail,
        stripe_axis=lit[0].stripe_axis,
    )  # fmt: skip


def _stripe(state: AdjustmentState, board: BoardSpec, camera_from_board: pin.SE3, radius: float, count: int) -> Array:
    """Pixels (n, 2), at most `count`, where light plane and board meet, in the picture and clear of the dots."""
    assert state.plane is not None
    normal = camera_from_board.rotation[:, 2]
    middle = transform(camera_from_board, centre_of(board))
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

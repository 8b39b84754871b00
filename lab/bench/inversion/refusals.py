"""Scans that must not lead to a wrong place: each ends within the job's tolerance or in a refusal.

Deformed and worn surfaces, other surfaces, disturbed calibrations, a wrong board pose, half a scan, foreign objects.
`coverage` shows beside it that the uncertainty of good scans is true, calibration error included.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion import Prior, Tolerance, invert_pose
from cell.measure.inversion.closest import Array
from cell.measure.reconstruction import Cloud
from drivers.errors import CellError
from lab.bench.inversion.parts import PARTS, nominal
from lab.bench.inversion.scenes import TRUE, Setting, scan

TOLERANCE = Tolerance(0.0006, 0.006)
"""The one of the job `pot`."""
BOARD = np.diag([0.003**2] * 3 + [np.radians(0.8) ** 2] * 3)
"""The prior that the job `pot` grants the board."""
CALIBRATION = np.array([4e-5, 4e-5, 4e-5, 1e-3, 5e-4])
"""Standard deviations of the drawn calibration errors: three shifts (m), the sweep's scale, its obliquity (rad)."""

Drawn = tuple[Cloud, pin.SE3, tuple[pin.SE3, ...]]
"""A cloud, what the board says but for its noise, and the poses that are right."""
Draw = Callable[[np.random.Generator], Drawn]
_POT = PARTS["pot"].height


def _moved(cloud: Cloud, motions: Array) -> Cloud:
    return replace(cloud, points=cloud.points + motions)


def _warped(warp: Callable[[Array, Array, np.random.Generator], Array], setting: Setting | None = None) -> Draw:
    def draw(rng: np.random.Generator) -> Drawn:
        return scan(PARTS["pot"], rng, setting, height=lambda x, y: _POT(x, y) + warp(x, y, rng)), TRUE, (TRUE,)

    return draw


def _bent(x: Array, y: Array, rng: np.random.Generator) -> Array:
    return np.asarray(rng.uniform(0.0003, 0.003) * rng.choice([-1, 1]) * (x / 0.035) ** 2)


def _twisted(x: Array, y: Array, rng: np.random.Generator) -> Array:
    return np.asarray(rng.uniform(0.0003, 0.002) * x * y / (0.035 * 0.018))


def _worn(x: Array, y: Array, rng: np.random.Generator) -> Array:
    return np.asarray(-rng.uniform(0.0003, 0.002) * (x > rng.uniform(-0.02, 0.02)) * np.clip(x + 0.02, 0, 1) / 0.05)


def _sunk(setting: Setting) -> Draw:
    """One side has sunk as a whole, a fracture: the pose of either side is a right one."""

    def draw(rng: np.random.Generator) -> Drawn:
        depth, edge = rng.uniform(0.0007, 0.004), rng.uniform(-0.01, 0.01)
        broken = scan(PARTS["pot"], rng, setting, height=lambda x, y: _POT(x, y) - depth * (x + 0.5 * y > edge))
        return broken, TRUE, (TRUE, TRUE * pin.SE3(np.eye(3), np.array([0.0, 0.0, -depth])))

    return draw


def _other(name: str) -> Draw:
    def draw(rng: np.random.Generator) -> Drawn:
        return scan(PARTS["pot"], rng, height=PARTS[name].height), TRUE, (TRUE,)

    return draw


def _flipped(sx: int, sy: int) -> Draw:
    def draw(rng: np.random.Generator) -> Drawn:
        return scan(PARTS["pot"], rng, height=lambda x, y: _POT(sx * x, sy * y)), TRUE, (TRUE,)

    return draw


def _scaled(rng: np.random.Generator) -> Drawn:
    k = 1 + rng.uniform(0.01, 0.06) * rng.choice([-1, 1])
    return scan(PARTS["pot"], rng, height=lambda x, y: _POT(x * k, y * k)), TRUE, (TRUE,)


def _disturbed(rng: np.random.Generator) -> Drawn:
    """0.3 mm and 0.1° somewhere in the chain: the cloud is moved, and sheared and bent a little."""
    cloud = scan(PARTS["pot"], rng)
    way, axis = rng.normal(size=3), rng.normal(size=3)
    arm = cloud.points - TRUE.translation
    move = 0.0003 * way / np.linalg.norm(way) + np.cross(np.radians(0.1) * axis / np.linalg.norm(axis), arm)
    bend = rng.normal(size=3) * 0.3 * (arm[:, :, 1:2] ** 2)
    return _moved(cloud, move + bend), TRUE, (TRUE,)


def _board_wrong(rng: np.random.Generator) -> Drawn:
    way = rng.normal(size=3)
    board = perturbed(TRUE, np.append(0.010 * way / np.linalg.norm(way), np.zeros(3)))
    return scan(PARTS["pot"], rng), board, (TRUE,)


def _of_setting(setting: Setting) -> Draw:
    return lambda rng: (scan(PARTS["pot"], rng, setting), TRUE, (TRUE,))


CASES: dict[str, Draw] = {
    "bent 0.3 to 3 mm": _warped(_bent),
    "twisted 0.3 to 2 mm": _warped(_twisted),
    "worn 0.3 to 2 mm on one side": _warped(_worn),
    "one side sunk 0.7 to 4 mm": _sunk(Setting()),
    "sunk, 40 % of it missing": _sunk(Setting(missing=0.4)),
    "another part: seat": _other("seat"),
    "another part: plate": _other("plate"),
    "mirrored": _flipped(-1, 1),
    "turned by 180°": _flipped(-1, -1),
    "1 to 6 % too large or small": _scaled,
    "calibration disturbed, 0.3 mm and 0.1°": _disturbed,
    "board wrong by 10 mm": _board_wrong,
    "half of the scan": _of_setting(Setting(missing=0.5)),
    "70 % missing": _of_setting(Setting(missing=0.7)),
    "40 % clutter": _of_setting(Setting(clutter=0.4)),
    "60 % clutter": _of_setting(Setting(clutter=0.6)),
}


@dataclass(frozen=True)
class Judged:
    """How a case ended: "within" the tolerance, "refused" for `reason`, or "outside" it by `error` (m, rad)."""

    case: str
    ended: str
    error: tuple[float, float] | None
    reason: str


def judge_case(case: str, seed: int) -> Judged:
    """Draw the case and the board's own error from `seed`, invert, and compare with the job's tolerance."""
    rng = np.random.default_rng(seed)
    cloud, expected, rights = CASES[case](rng)
    board = perturbed(expected, 0.5 * rng.normal(size=6) * np.sqrt(np.diag(BOARD)))
    try:
        pose = invert_pose(cloud, nominal("pot"), Prior(board, BOARD), TOLERANCE)
    except CellError as error:
        return Judged(case, "refused", None, str(error))
    off = min(PARTS["pot"].error(pose.base_from_surface, right) for right in rights)
    good = off[0] <= TOLERANCE.translation and off[1] <= TOLERANCE.rotation
    return Judged(case, "within" if good else "outside", off, "")


def coverage(seed: int) -> tuple[Array, float]:
    """Normalised error (6,) and squared Mahalanobis distance of a good scan, board and calibration errors drawn."""
    rng = np.random.default_rng([seed, 1])
    part = ("pot", "seat")[seed % 2]
    cloud = scan(PARTS[part], rng, Setting(missing=0.2 * (seed % 3)))
    arm = cloud.points - TRUE.translation
    ways = np.zeros((*cloud.points.shape, 5))
    ways[..., 0, 0] = ways[..., 1, 1] = ways[..., 2, 2] = 1.0
    ways[..., 0, 3] = ways[..., 1, 4] = arm[:, :, 0]
    ways *= CALIBRATION
    moved = _moved(cloud, ways @ rng.normal(size=5))
    prior = Prior(perturbed(TRUE, rng.normal(size=6) * np.sqrt(np.diag(BOARD))), BOARD)
    pose = invert_pose(moved, nominal(part), prior, TOLERANCE, calibration=lambda lines, rows: ways[lines, rows])
    error = difference(pose.base_from_surface, TRUE)
    return error / pose.sigma, float(error @ np.linalg.solve(pose.covariance, error))

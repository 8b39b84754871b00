"""Clouds of the inversion campaigns: a part on a table as a sweep gives it, with noise, outliers, foreign objects and
missing data, at a known pose. The noise is drawn here, from the closed form of the part; no renderer is involved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.poses import perturbed
from cell.measure.inversion.closest import Array
from cell.measure.reconstruction import Cloud
from lab.bench.inversion.parts import Part

Mask = NDArray[np.bool_]

STRIPE_SIGMA, RAIL_SIGMA = 40e-6, 8e-6
"""Standard deviations of the drawn noise, m: of a point by its stripe centre, and of a line by the rail."""
TRUE = pin.SE3(pin.exp3(np.array([0.01, -0.02, 0.03])), np.array([0.75, 0.01, 0.05]))
"""base_from_surface of every scene, before `Scene.moved`."""
LINES, ROWS = 200, 200


@dataclass(frozen=True)
class Setting:
    """What is wrong with a scan: shares of the part's points that are clutter or missing, and of wild ones."""

    clutter: float = 0.0
    missing: float = 0.0
    wild: float = 0.01


SETTINGS = {
    "clean": Setting(),
    "40 % missing": Setting(missing=0.4),
    "20 % clutter": Setting(clutter=0.2),
    "both": Setting(clutter=0.2, missing=0.4),
}


def scan(
    part: Part,
    rng: np.random.Generator,
    setting: Setting | None = None,
    *,
    sigma: float = STRIPE_SIGMA,
    height: Callable[[Array, Array], Array] | None = None,
    true: pin.SE3 = TRUE,
) -> Cloud:
    """A cloud of `part` and the table around it, arm base; `height` is another surface that lies in its place."""
    setting = setting or Setting()
    reach_x, reach_y = (0.024, 0.024) if part.round else (0.038, 0.021)
    shift = rng.uniform(-0.0015, 0.0015, 2)
    x, y = np.meshgrid(
        np.linspace(-reach_x, reach_x, LINES) + shift[0], np.linspace(-reach_y, reach_y, ROWS) + shift[1], indexing="ij"
    )
    inside = part.inside(x, y)
    z = np.where(inside, (height or part.height)(x, y), 0.0)
    if setting.clutter:
        z = _cluttered(x, y, z, inside, setting.clutter, rng)
    if setting.missing:
        z = np.where(_hidden(x, y, inside, setting.missing, rng), np.nan, z)
    points = np.stack([x, y, z], -1)
    across = np.array([0.06, 0.0, 1.0]) * sigma
    points += across * rng.standard_normal((LINES, ROWS, 1))
    points[:, :, 0] += RAIL_SIGMA * rng.standard_normal((LINES, 1))
    wild = rng.random((LINES, ROWS)) < setting.wild
    points[wild, 2] += rng.uniform(-0.004, 0.004, int(wild.sum()))
    points[~np.isfinite(z)] = np.nan
    return Cloud(
        points=points @ true.rotation.T + true.translation,
        stripe_spread=np.broadcast_to(across @ true.rotation.T, points.shape).astype(np.float32),
        rail_spread=np.tile(true.rotation[:, 0] * RAIL_SIGMA, (LINES, 1)),
        centres=np.zeros((LINES, ROWS)),
        rail=np.linspace(0.0, 2 * reach_x, LINES),
        rejected=np.zeros((LINES, ROWS), dtype=bool),
    )


def _cluttered(x: Array, y: Array, z: Array, inside: Mask, share: float, rng: np.random.Generator) -> Array:
    """Foreign objects on the part, chips and washers 0.15 to 6 mm high, until they hide `share` of its points."""
    places = np.argwhere(inside)
    hidden = np.zeros_like(inside)
    while hidden.sum() < share * inside.sum():
        i, j = places[rng.integers(len(places))]
        turn, long, short = rng.uniform(0, np.pi), rng.uniform(0.002, 0.006), rng.uniform(0.001, 0.004)
        u = (x - x[i, j]) * np.cos(turn) + (y - y[i, j]) * np.sin(turn)
        v = (y - y[i, j]) * np.cos(turn) - (x - x[i, j]) * np.sin(turn)
        under = inside & ((np.abs(u) < long) & (np.abs(v) < short) if rng.random() < 0.5 else u**2 + v**2 < short**2)
        top = np.nanmax(np.where(under, z, -np.inf)) + np.exp(rng.uniform(np.log(0.00015), np.log(0.006)))
        lying = rng.random() < 0.5
        z = np.where(under, top if lying else z + (top - z[i, j] if np.isfinite(z[i, j]) else 0.001), z)
        hidden |= under
    return z


def _hidden(x: Array, y: Array, inside: Mask, share: float, rng: np.random.Generator) -> Mask:
    """Where nothing was seen: one side of the part, then patches, until `share` of its points are missing."""
    direction = rng.uniform(0, 2 * np.pi)
    along = np.cos(direction) * x / np.ptp(x) + np.sin(direction) * y / np.ptp(y)
    hidden = along > np.quantile(along[inside], 1 - 0.5 * share)
    places = np.argwhere(inside)
    while (hidden & inside).sum() < share * inside.sum():
        i, j = places[rng.integers(len(places))]
        hidden |= np.hypot(x - x[i, j], y - y[i, j]) < rng.uniform(0.002, 0.006)
    return np.asarray(hidden)


def start_away(rng: np.random.Generator, metres: float, degrees: float, true: pin.SE3 = TRUE) -> pin.SE3:
    """A pose `metres` and `degrees` away from `true`, in random directions."""
    way, axis = rng.normal(size=3), rng.normal(size=3)
    turn = np.radians(degrees) * axis / np.linalg.norm(axis)
    return perturbed(true, np.concatenate([metres * way / np.linalg.norm(way), turn]))

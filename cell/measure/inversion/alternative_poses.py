"""Other places at which a scan fits the surface as well: teeth, patterns of holes.

An inversion that begins near such a place ends there, with small residuals and a small sigma, and is wrong. So the scan
is laid onto the surface from every place around the one that was found, and the board has to tell them apart.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion.nominal import Array, NominalSurface, Scan, sigmas_along
from cell.measure.inversion.nominal import correspondences as matched
from cell.measure.inversion.observability import FREE
from cell.measure.inversion.registration import MOST_SHIFT, Prior, candidates
from drivers.errors import Measured, RefusedError

POINTS = 400
"""Of the scan, that are laid onto the surface."""
MOST_PLACES = 12
OVER = 0.6
"""Share of the points that has to lie over the surface at another place, of those that do at the one that was found."""
AS_WELL = 0.97
"""Share of the points over the surface that fit it there, of those that do here, from which on the scan does not tell
the two apart."""
WITHIN, LEAST_M = 4.0, 5e-5
"""A point fits within so many of its σ, or so near, m."""
TOLD_APART = 25.0
"""By so much more, in squared σ, the board has to be against the other place: 5 σ."""
LEAST_TOLD = 3 * FREE
"""Least information of a motion, in those of a point along its normal, for it to lead to another place."""
APART_M = 1e-3
"""By less at the surface no other place is one of its own."""
STEPS, GATE = 12, 0.002


def require_alone(scan: Scan, pose: pin.SE3, nominal: NominalSurface, prior: Prior, information: Array) -> None:
    """Refuse a place base_from_surface beside which there is another one that scan and board allow as well.

    `information` (6, 6) of the scan on the pose, surface axes: along a motion that it leaves to the board there are no
    separate places. Raises `RefusedError` with the shift and turn to the other place.
    """
    some = scan.thinned(POINTS)
    here = _fitting(pose, some, nominal)
    off = difference(pose, prior.base_from_surface)
    board = prior.information()
    spread = np.sqrt(np.diag(prior.covariance))
    shift = min(float(np.sqrt(TOLD_APART) * spread[:3].max() + np.linalg.norm(off[:3])), MOST_SHIFT)
    turn = float(np.sqrt(TOLD_APART) * spread[3:].max() + np.linalg.norm(off[3:]))
    for start in candidates(pose, some.points, nominal, shift=shift, turn=turn, most=MOST_PLACES):
        other = settled(start, some.points, nominal)
        moved = pose.inverse() * other
        middle = moved.act(nominal.centre) - nominal.centre
        turned = float(np.linalg.norm(pin.log3(moved.rotation)))
        if np.linalg.norm(middle) + turned * nominal.radius < APART_M:
            continue
        away = difference(other, prior.base_from_surface)
        against = float(away @ board @ away - off @ board @ off)
        if against > TOLD_APART or not observable(moved, information, nominal.radius):
            continue
        there = _fitting(other, some, nominal)
        if there[0] < OVER * here[0] or there[1] < AS_WELL * here[1]:
            continue
        x, y, z = 1e3 * middle
        raise RefusedError(
            f"the surface looks the same elsewhere: shifted by ({x:.1f}, {y:.1f}, {z:.1f}) mm and turned by "
            f"{1e3 * turned:.0f} mrad, {100 * there[1]:.0f} % of the scan fit it (here {100 * here[1]:.0f} %), and the "
            f"board speaks against that place by {np.sqrt(max(0.0, against)):.1f} σ only, {np.sqrt(TOLD_APART):.0f} "
            "are needed. Scan also what is there once only, or have the station hold the surface more exactly and "
            "state it (surface.prior_sigma)",
            Measured("board against the other place", float(np.sqrt(max(0.0, against))), "σ", least=TOLD_APART**0.5),
        )


def observable(where: pin.SE3, information: Array, radius: float) -> bool:
    """Whether the scan tells this motion at all, by its `information` (6, 6) in the same axes."""
    length = np.array([1.0] * 3 + [radius] * 3)
    motion = np.concatenate([where.translation, pin.log3(where.rotation)]) * length
    scaled = information / np.outer(length, length)
    return bool(motion @ scaled @ motion > LEAST_TOLD * float(motion @ motion) * np.trace(scaled[:3, :3]))


def settled(pose: pin.SE3, points: Array, nominal: NominalSurface) -> pin.SE3:
    """Point to plane, a few steps; motions that the points (n, 3) leave open stay where they are."""
    for _ in range(STEPS):
        index, feet = nominal.feet((points - pose.translation) @ pose.rotation, GATE)
        keep = feet.inner
        normals = feet.normals[keep] @ pose.rotation.T
        arms = points[index[keep]] - pose.translation
        rows = -np.concatenate([normals, np.cross(arms, normals)], axis=1)
        if len(rows) < len(points) // 8:
            return pose
        damping = 1e-3 * len(rows) * np.diag([1.0] * 3 + [nominal.radius**2] * 3)
        step = -np.linalg.solve(rows.T @ rows + damping, rows.T @ feet.heights[keep])
        pose = perturbed(pose, step)
        if np.abs(step[:3]).max() < 1e-6:
            break
    return pose


def _fitting(pose: pin.SE3, scan: Scan, nominal: NominalSurface) -> tuple[int, float]:
    """How many points lie over the surface, and the share of those that lie on it."""
    rows = matched(pose, scan, nominal, GATE)
    if not len(rows.index):
        return 0, 0.0
    on = np.abs(rows.heights) < np.maximum(WITHIN * sigmas_along(scan, rows), LEAST_M)
    return len(rows.index), float(on.mean())

"""Where a part lies on its surface, from one sweep of the part and of what shows of the surface beside it.

What the arm's pose and the calibration are off by moves part and surface alike in one sweep, and cancels between them.
Where too little of the surface shows, it is taken to lie where an earlier sweep found it, with what that is off by.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import composition_jacobians, difference
from cell.measure.inversion.demands import Demands
from cell.measure.inversion.effects.during_sweep import find_rocking, rocking_motions
from cell.measure.inversion.nominal import Array, Indices, NominalSurface, Scan
from cell.measure.inversion.observability import Tolerance, determined, judge
from cell.measure.inversion.place_pose import PlacePose, balance, invert_pose, shared_by_patches
from cell.measure.inversion.registration import Prior, register
from cell.measure.reconstruction.cloud import Cloud, Motions
from drivers.errors import ConfigError, RefusedError

FACING_UP = 0.3
"""Cosine from the surface's z axis up to which a face of the part is one that the sweep sees."""
SHIFTED = np.array([2e-3] * 3 + [2e-2] * 3)
"""One standard deviation of where a part put down wrongly may lie, m and rad: it is found up to thrice that."""
ABOUT_M = 4e-3
"""So far around the part, where it belongs, its points are looked for."""
BESIDE_M = 1.5e-3
"""Nearer to the part, seen from above, nothing counts as the surface beside it."""
SURFACE_MOVED = 40.0
"""χ² of six degrees of freedom from which the surface does not lie where the earlier sweep found it."""
LEAST_BESIDE = 500
MOST_POINTS = 10_000
NOISE_M = 20e-6
"""Of a point of a sweep, one standard deviation, roughly."""
FORM_M = 1e-6
"""What neighbouring points of part or surface are off by together, unless they show more: their distances tell it so
finely. A scan's own bound allows for more, which would hide here what is to be seen."""
DEMANDS = Demands(coverage=0.25)
"""Less than of a surface: a sweep sees a strip of a part."""


@dataclass(frozen=True, eq=False)
class PartPose:
    """Where a part was seen: `surface_from_part`, and its `covariance` (6, 6), m² and rad², surface axes, about the
    part's origin.

    `fit` is how its faces lie in the scan; its verdict names the motions that these do not show. `beside` is the number
    of points of the surface that showed beside the part; 0 where the earlier sweep tells where that lies, which is at
    `base_from_surface`. The vehicle rocked by `rocked`, m, up and down, as far as the sweep shows it. `moved` is how
    the surface has moved in the arm base since the earlier sweep, (6,) m and rad; None where it lies as it lay. It
    seems to lie `far` from there, χ² of six degrees of freedom.
    """

    base_from_surface: pin.SE3
    surface_from_part: pin.SE3
    covariance: Array
    fit: PlacePose
    beside: int
    rocked: float = 0.0
    moved: Array | None = None
    far: float = 0.0


def seen_from_above(part: NominalSurface, surface_from_part: pin.SE3) -> NominalSurface:
    """The faces of a part that a sweep from above sees. Raises `ConfigError` where it has none."""
    up = part.normals @ surface_from_part.rotation.T[:, 2] > FACING_UP
    if not up.any():
        raise ConfigError("no face of part.mesh faces up where the part lies: nothing of the placed part can be seen")
    # Of its own corners alone: their box is that of the faces.
    corners, triangles = np.unique(part.triangles[up], return_inverse=True)
    return NominalSurface(part.vertices[corners], triangles.reshape(-1, 3), source=part.source)


def seen_from_below(part: NominalSurface, surface_from_part: pin.SE3) -> NominalSurface:
    """The faces of a part that face down where it lies, turned over: the ground that fits it. Raises `ConfigError`."""
    turned = NominalSurface(part.vertices, part.triangles[:, ::-1])
    try:
        return seen_from_above(turned, surface_from_part)
    except ConfigError as error:
        raise ConfigError("no face of part.mesh faces down where the part lies: it has no underside") from error


def shown_by(faces: NominalSurface, tolerance: Tolerance) -> tuple[str, ...]:
    """In words the motions of a part that its `faces` as drawn do not show within `tolerance`, part frame."""
    points = faces.samples[:: max(1, len(faces.samples) // MOST_POINTS)]
    normals = faces.normals[faces.sample_triangles[:: max(1, len(faces.samples) // MOST_POINTS)]]
    rows = np.concatenate([normals, np.cross(points, normals)], axis=1) / NOISE_M
    told, _ = determined(rows, faces.radius)
    covariance = np.asarray(np.linalg.inv(told + np.diag(SHIFTED**-2.0)), dtype=np.float64)
    verdict = judge(covariance, told, NOISE_M**2, points=len(points), radius=faces.radius, tolerance=tolerance)
    return tuple(of_part(motion.words.partition(" is ")[0]) for motion in verdict.weak)


def of_part(words: str) -> str:
    """The name of a motion, which is that of a surface, for a part."""
    return words.replace("surface frame", "part frame")


def find_part(
    cloud: Cloud, faces: NominalSurface, nominal: NominalSurface, surface: Prior, belongs: pin.SE3,
    tolerance: Tolerance, moved: Motions, *, times: Array, base_from_vehicle: pin.SE3,
) -> PartPose:  # fmt: skip
    """Where the part with these `faces`, which `belongs` at surface_from_part, lies in a sweep's cloud, arm base.

    `surface` is where the earlier sweep found the surface, with its covariance. `moved` says how one standard deviation
    of each independent parameter of this sweep displaces its points; `times` (lines,) s is when its lines were taken: a
    vehicle that rocks is seen in them. Raises `RefusedError` where the part is not found.
    """
    on_part, around = parted(cloud, faces, surface.base_from_surface * belongs)

    def found(rocked: Motions | None) -> PartPose:
        beside = _surface_beside(around, nominal, surface, moved, rocked)
        return _against(beside, on_part, faces, belongs, tolerance=tolerance, moved=moved, rocked=rocked)

    def steadied(pose: pin.SE3) -> PartPose | None:
        rocking = find_rocking(on_part, faces, pose, times)
        if rocking is None:
            return None
        motions = partial(rocking_motions, cloud, base_from_vehicle=base_from_vehicle, times=times, hz=rocking.hz)
        return replace(found(motions), rocked=rocking.height)

    try:
        still = found(None)
    except RefusedError as refused:
        # The waves of a vehicle that rocks are much for a quarter of a small part.
        pose = refused.seen.get("pose")
        if not isinstance(pose, pin.SE3) or (steady := steadied(pose)) is None:
            raise
        return steady
    return steadied(still.fit.base_from_surface) or still


@dataclass(frozen=True, eq=False)
class _SurfaceSeen:
    """Where the surface lies by what shows of it beside the part: `base_from_surface`, its own covariance `unsure`
    (6, 6), base axes, how it `follows` each parameter (6, m), the number of its `points`, how it has `moved` (6,) since
    the earlier sweep, None where it has not, and how `far` it seems to be from there, χ²."""

    base_from_surface: pin.SE3
    unsure: Array
    follows: Array
    points: int
    moved: Array | None = None
    far: float = 0.0


def _surface_beside(
    around: Cloud, nominal: NominalSurface, surface: Prior, moved: Motions, rocked: Motions | None
) -> _SurfaceSeen:
    """From the points `around` the part; where too few of these are of the surface, as the earlier sweep has it."""
    known = _SurfaceSeen(surface.base_from_surface, surface.covariance, np.zeros((6, 0)), 0)
    if around.size < LEAST_BESIDE:
        return known
    scan, (lines, rows) = Scan.of(around, MOST_POINTS), around.subsample(MOST_POINTS)

    def seen(prior: Prior) -> _SurfaceSeen | None:
        try:
            found = register(scan, nominal, prior)
        except RefusedError:
            # A table, or whatever else lies there.
            return None
        if len(found.used) < LEAST_BESIDE or not found.share >= DEMANDS.share:
            return None
        if rocked is not None:
            found = balance(found, scan, rocked(lines[found.used], rows[found.used]), prior)
        along = np.einsum("ni,nim->nm", found.normals, moved(lines[found.used], rows[found.used]))
        _, patches = shared_by_patches(found, FORM_M)
        return _SurfaceSeen(found.base_from_surface, found.covariance + patches, found.follow @ along, len(found.used))

    # What the earlier sweep says would hold back a surface, or a vehicle, that has moved since.
    alone = seen(Prior(surface.base_from_surface, surface.covariance + np.diag(SHIFTED**2)))
    if alone is None:
        return known
    apart = difference(alone.base_from_surface, surface.base_from_surface)
    spread = surface.covariance + alone.unsure + alone.follows @ alone.follows.T
    far = float(apart @ np.linalg.solve(spread, apart))
    if far > SURFACE_MOVED:
        return replace(alone, moved=apart, far=far)
    return replace(seen(surface) or known, far=far)


def _against(
    beside: _SurfaceSeen, on_part: Cloud, faces: NominalSurface, belongs: pin.SE3, *, tolerance: Tolerance,
    moved: Motions, rocked: Motions | None,
) -> PartPose:  # fmt: skip
    """The part in its points, against the surface."""
    there = beside.base_from_surface

    def differently(lines: Indices, rows: Indices) -> Array:
        """How the points move beside the surface, which follows what moves them."""
        own = moved(lines, rows)
        if not beside.points:
            return own
        arms = on_part.points[lines, rows] - there.translation
        with_it = beside.follows[:3] + np.cross(beside.follows[3:].T[None], arms[:, None]).transpose(0, 2, 1)
        return np.asarray(own - with_it)

    carried = composition_jacobians(there, belongs)[0]
    fit = invert_pose(
        on_part, faces, Prior(there * belongs, np.diag(SHIFTED**2)), tolerance,
        systematic=carried @ beside.unsure @ carried.T, calibration=differently, sweeps=rocked, demands=DEMANDS,
        most_points=MOST_POINTS, partly=True, least_shared=FORM_M,
    )  # fmt: skip
    turn = np.kron(np.eye(2), there.rotation.T)
    return PartPose(
        there, there.inverse() * fit.base_from_surface, turn @ fit.covariance @ turn.T, fit, beside.points,
        moved=beside.moved, far=beside.far,
    )  # fmt: skip


def parted(cloud: Cloud, faces: NominalSurface, base_from_part: pin.SE3) -> tuple[Cloud, Cloud]:
    """The points of a cloud, arm base, about the part with these `faces`, where it is expected, and those beside it."""
    low, high = faces.extent
    local = (cloud.points - base_from_part.translation) @ base_from_part.rotation
    # A comparison with what is no number is false: holes are of neither.
    about = ((local > low - ABOUT_M) & (local < high + ABOUT_M)).all(axis=2)
    clear = ((local < low - BESIDE_M) | (local > high + BESIDE_M))[..., :2].any(axis=2)
    return _only(cloud, about), _only(cloud, clear)


def _only(cloud: Cloud, kept: Array) -> Cloud:
    return replace(cloud, points=np.where(kept[..., None], cloud.points, np.nan))

"""What the planned sweeps will see of the drawn surface: the stripe on it, line by line, as the scan head is drawn.

Everything is in the surface frame S, as if the arm's base were there. No noise and no blur: which points there will be,
and how a stripe's centre that is off by `STRIPE_PX` moves each of them.

Rays against a mesh: what they meet first, and whether anything lies between an eye and a point of it.

Other places at which the sweeps would fit the surface as well: teeth, patterns of holes, little that tells.

An inversion that begins near such a place ends there, with small residuals and a small sigma, and is wrong. So the
points that the sweeps will see are laid onto the surface from every place that the board leaves open."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.check.reach import nominal_scan
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.measure.geometry.light_plane import triangulate
from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.nominal import SIGMA_FLOOR
from cell.measure.inversion.place_pose import observable, settled
from cell.measure.inversion.registration import MOST_SHIFT, candidates
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.arm.photograph import ScanPlan, scan_plans
from drivers.errors import ConfigError
from drivers.packages import lacking

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

ABOVE: Array = np.array([0.0, 0.0, 1.0])
"""The direction of an eye straight above, surface frame."""
SMOOTH = 0.9
"""Cosine of the angle (26 degrees) up to which neighbouring triangles are taken for one smooth surface."""
MOST_MEETING = 400
"""Triangles that meet in a corner, from which on it is taken as it is: the middle of a flat cap."""
NEAR = 2e-5
"""Hits nearer to each other than this along a ray are one, m."""


class Rays:
    """Rays against the triangles of `vertices` (n, 3) m and `faces` (m, 3)."""

    def __init__(self, vertices: Array, faces: Faces) -> None:
        if missing := lacking("embreex", "embreex"):
            raise ConfigError(f"what a camera sees of the body cannot be found: {missing}")
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.normals: Array = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self._corners = corners
        self._faces = faces
        self._smooth: Array | None = None
        self._rays = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))

    def hits(self, origins: Array, ways: Array) -> tuple[NDArray[np.int64], Array]:
        """The first triangle (n,) that rays from `origins` (n, 3) along unit `ways` (n, 3) meet, −1 for none, and how
        far away it is, m."""
        triangle = np.asarray(self._rays.intersects_first(origins, ways), dtype=np.int64)
        distance = np.full(len(origins), np.inf)
        hit = np.flatnonzero(triangle >= 0)
        # By the triangle's own plane, in double precision: the library answers in single.
        normal, first = self.normals[triangle[hit]], self._corners[triangle[hit], 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.einsum("ni,ni->n", first - origins[hit], normal) / np.einsum("ni,ni->n", ways[hit], normal)
        distance[hit] = np.where(np.isfinite(found), found, np.inf)
        return triangle, distance

    def open_between(self, points: Array, eyes: Array) -> NDArray[np.bool_]:
        """(n,) whether nothing lies between each of `eyes` (n, 3) and the point (n, 3) on the mesh."""
        return np.asarray(self.behind(points, eyes) > -NEAR)

    def behind(self, points: Array, eyes: Array) -> Array:
        """(n,) how far behind the point (n, 3) that lies which each of `eyes` (n, 3) sees there first, m."""
        ways = points - eyes
        length = np.linalg.norm(ways, axis=1)
        return np.asarray(self.hits(eyes, ways / length[:, None])[1] - length)

    def smooth_normals(self, triangles: NDArray[np.int64], points: Array) -> Array:
        """Unit normals (n, 3) at points on triangles (n,), of the smooth surface that the triangles stand for. By the
        flat triangles' own normals a round part would seem to tell how it is turned: only its facets do."""
        if self._smooth is None:
            self._smooth = _corner_normals(self._corners, self._faces, self.normals)
        a, b, c = self._corners[triangles].transpose(1, 0, 2)
        whole = np.cross(b - a, c - a)
        square = np.einsum("ni,ni->n", whole, whole)
        second = np.einsum("ni,ni->n", np.cross(points - a, c - a), whole) / square
        third = np.einsum("ni,ni->n", np.cross(b - a, points - a), whole) / square
        shares = np.stack([1.0 - second - third, second, third], axis=1)
        made = np.einsum("nk,nki->ni", shares, self._smooth[triangles])
        return np.asarray(made / np.linalg.norm(made, axis=1, keepdims=True))


def _corner_normals(corners: Array, faces: Faces, normals: Array) -> Array:
    """(m, 3, 3) normals at the corners of each triangle: the mean of those that meet there and are nearly as steep,
    weighted by their angles."""
    sides = np.roll(corners, -1, axis=1) - corners
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    angles = np.arccos(np.clip(-np.einsum("nki,nki->nk", sides, np.roll(sides, 1, axis=1)), -1.0, 1.0)).ravel()
    at = faces.ravel()
    order = np.argsort(at, kind="stable")
    count = np.bincount(at)
    begin = np.cumsum(count) - count
    few = np.where(count[at] <= MOST_MEETING, count[at], 0)
    mine = np.repeat(np.arange(len(at)), few)
    place = np.arange(len(mine)) - np.repeat(np.cumsum(few) - few, few)
    other = order[begin[at[mine]] + place]
    near = np.einsum("ni,ni->n", normals[mine // 3], normals[other // 3]) > SMOOTH
    made = np.array(np.repeat(1e-9 * normals, 3, axis=0))
    for k in range(3):
        made[:, k] += np.bincount(mine[near], angles[other[near]] * normals[other[near] // 3, k], minlength=len(at))
    made[few == 0] = normals[np.flatnonzero(few == 0) // 3]
    return np.asarray((made / np.linalg.norm(made, axis=1, keepdims=True)).reshape(-1, 3, 3))


STRIPE_PX = 0.12
"""One standard deviation of a stripe's centre, px: what speckle leaves on a matt surface."""
LINE_STEP, ROWS = 0.001, 160
"""Lines of the sweep that are looked at, m apart, and places along each stripe."""
PATCH = 2
"""Places along the stripe to each side, about half a millimetre, that a point needs around it to count."""
NEAREST, FARTHEST = 0.100, 0.165
"""How near and how far, m, a surface may be from the scan camera: beyond, its stripe is too broad, and too far from the
depths at which the head is calibrated."""
GRAZING = 0.2
"""Cosine beyond which light or sight graze the surface too much for a stripe."""


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """What one sweep sees: `points` (lines, rows, 3) m and their `normals`, NaN where there is none, `spread` (lines,
    rows, 3) m by the stripe's noise, the `flanges` (lines, 4, 4), the `rail` (lines,), m, and the way of the sweep.

    `eyes` and `lamps` (lines, 3) are where camera and laser were, m.
    """

    points: Array
    normals: Array
    spread: Array
    flanges: Array
    rail: Array
    along: Array
    eyes: Array
    lamps: Array

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(lines, rows) where there is a point."""
        return np.isfinite(self.points[:, :, 0])

    @property
    def solid(self) -> NDArray[np.bool_]:
        """(lines, rows) the points that lie within a smooth patch: along the stripe and in a neighbouring line the
        surface goes on as it is. On a narrower one a stripe is bent, and at an edge it is mixed."""
        valid = self.valid
        same = np.ones(valid.shape, dtype=np.bool_)
        for step in (-PATCH, PATCH):
            same &= _alike(self.normals, np.roll(self.normals, step, axis=1))
        beside = [_alike(self.normals, np.roll(self.normals, step, axis=0)) for step in (-1, 1)]
        same[:, :PATCH] = same[:, -PATCH:] = False
        return np.asarray(valid & same & (beside[0] | beside[1]))

    def information(self, used: NDArray[np.bool_]) -> Array:
        """(6, 6) of the surface's pose (translation m, rotation rad; S) that the points `used` (lines, rows) give."""
        points, normals = self.points[used], self.normals[used]
        sigma = np.hypot(np.einsum("ni,ni->n", self.spread[used], normals), SIGMA_FLOOR)
        rows = np.concatenate([normals, np.cross(points, normals)], axis=1) / sigma[:, None]
        return np.asarray(rows.T @ rows)


def _alike(normals: Array, others: Array) -> NDArray[np.bool_]:
    return np.asarray(np.einsum("lri,lri->lr", normals, others) > SMOOTH)


def visible_surfaces(config: CellConfig, job: Job, rays: Rays) -> list[SeenSurface]:
    """What each of the job's sweeps sees of the surface that `rays` meet, as drawn."""
    return [
        _sweep(config, job, plan, rays) for plan in scan_plans(config, job, pin.SE3.Identity(), nominal_scan(config))
    ]


def _sweep(config: CellConfig, job: Job, plan: ScanPlan, rays: Rays) -> SeenSurface:
    head = nominal_scan(config)
    count = max(12, int(job.scan.length / LINE_STEP) + 1)
    shares = np.linspace(0.0, 1.0, count)
    rail = plan.rail_start + shares * (plan.rail_stop - plan.rail_start)
    way = plan.base_from_flange_end.translation - plan.base_from_flange.translation
    flanges = [from_parts(share * way) * plan.base_from_flange for share in shares]
    cameras = [flange * head.flange_from_camera_at(float(at)) for flange, at in zip(flanges, rail, strict=True)]
    turns, eyes = np.array([pose.rotation for pose in cameras]), np.array([pose.translation for pose in cameras])
    lamps = eyes + turns @ config.laser.exit_point
    # Rays of the laser's fan, a little wider than the picture.
    slopes = 1.1 * np.linspace(-0.5, 0.5, ROWS) * head.camera.height / head.camera.fy
    middle = np.array([1.0 / config.laser.tan_theta, 0.0, 1.0])
    fan = middle + np.outer(slopes, [0.0, 1.0, 0.0])
    fan /= np.linalg.norm(fan, axis=1, keepdims=True)
    ways = np.einsum("lij,rj->lri", turns, fan)
    origins = np.repeat(lamps, ROWS, axis=0)
    triangle, distance = rays.hits(origins, ways.reshape(-1, 3))
    met = np.flatnonzero(triangle >= 0)
    line = met // ROWS
    points = origins[met] + distance[met, None] * ways.reshape(-1, 3)[met]
    normals = rays.smooth_normals(triangle[met], points)
    local = np.einsum("nij,ni->nj", turns[line], points - eyes[line])
    pixels = head.camera.project(local)
    sight = (eyes[line] - points) / np.linalg.norm(eyes[line] - points, axis=1, keepdims=True)
    keep = ((pixels >= 0) & (pixels <= (head.camera.width - 1, head.camera.height - 1))).all(axis=1)
    keep &= (local[:, 2] >= NEAREST) & (local[:, 2] <= FARTHEST)
    keep &= np.einsum("ni,ni->n", normals, sight) > GRAZING
    keep &= -np.einsum("ni,ni->n", normals, ways.reshape(-1, 3)[met]) > GRAZING
    keep[keep] = rays.open_between(points[keep], eyes[line[keep]])
    made = [np.full((count * ROWS, 3), np.nan) for _ in range(3)]
    _, by_pixel = triangulate(head.camera, head.light_plane, pixels[keep])
    spread = STRIPE_PX * np.einsum("nij,nj->ni", turns[line[keep]], by_pixel[:, :, 0])
    for values, into in zip((points[keep], normals[keep], spread), made, strict=True):
        into[met[keep]] = values
    shape = (count, ROWS, 3)
    return SeenSurface(
        made[0].reshape(shape), made[1].reshape(shape), made[2].reshape(shape),
        np.array([flange.homogeneous for flange in flanges]), rail=rail, along=turns[0][:, 0], eyes=eyes, lamps=lamps,
    )  # fmt: skip


def as_cloud(seen: list[SeenSurface], rail_sigma: float) -> Cloud:
    """The sweeps as the cloud that they would make without noise, in the surface frame."""
    lines = [len(each.rail) for each in seen]
    points = np.concatenate([each.points for each in seen])
    return Cloud(
        points=points, stripe_spread=np.concatenate([each.spread for each in seen]).astype(np.float32),
        rail_spread=np.concatenate([np.tile(rail_sigma * each.along, (len(each.rail), 1)) for each in seen]),
        centres=np.zeros(points.shape[:2]), rail=np.concatenate([each.rail for each in seen]),
        rejected=np.zeros(points.shape[:2], dtype=np.bool_), flanges=np.concatenate([each.flanges for each in seen]),
        sweeps=np.repeat(np.arange(len(seen)), lines),
    )  # fmt: skip


POINTS = 600
"""Of the sweeps, that are laid onto the surface."""
MOST_PLACES = 24
FITS, ON = 0.98, 1e-4
"""Share of the points that lie this near, m, to the surface at a place that cannot be told from the true one."""
OVER = 0.6
"""Share of the points that has to lie over the surface there at all, as a job demands it."""
GATE = 0.002


def rivals(seen: Sequence[SeenSurface], nominal: NominalSurface, job: Job) -> list[tuple[Array, float]]:
    """Shifts (3,) m of the surface's middle, and turns, rad, of other places that fit as well, the nearest first.

    Looked for within six standard deviations of the prior, at most 10 mm across: the surface may lie at one end of the
    three that a job searches, and seem to lie at the other.
    """
    points = np.concatenate([each.points[each.solid] for each in seen])
    if len(points) < POINTS // 4:
        return []
    points = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
    shift, turn = min(6 * job.surface.prior_sigma, MOST_SHIFT), 6 * job.surface.prior_sigma_angle
    information = sum((each.information(each.solid) for each in seen), np.zeros((6, 6)))
    found: list[tuple[Array, float]] = []
    for start in candidates(pin.SE3.Identity(), points, nominal, shift=shift, turn=turn, most=MOST_PLACES):
        where = settled(start, points, nominal)
        turned = float(np.linalg.norm(pin.log3(where.rotation)))
        middle = where.act(nominal.centre) - nominal.centre
        same = np.linalg.norm(middle) < job.place.tolerance and turned < job.place.tolerance_angle
        near = np.linalg.norm(middle) <= np.sqrt(2) * shift and turned <= turn
        if near and not same and observable(where, information, nominal.radius) and _fit(where, points, nominal) > FITS:
            found.append((np.asarray(middle), turned))
    return sorted(found, key=lambda each: float(np.linalg.norm(each[0])))


def _fit(pose: pin.SE3, points: Array, nominal: NominalSurface) -> float:
    """Share of the points over the surface that lie on it; 0 where too few are over it."""
    _, feet = nominal.feet((points - pose.translation) @ pose.rotation, GATE)
    over = feet.inner
    return 0.0 if over.sum() < OVER * len(points) else float((np.abs(feet.heights[over]) < ON).mean())

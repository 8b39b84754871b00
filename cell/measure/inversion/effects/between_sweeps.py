"""What moved between two sweeps: the surface at once, or vehicle and floor slowly.

Has a surface moved between two scans of it? The second one need have a few lines only.

What the surface is shaped like beside its model is in both scans: their heights over the model are compared where they
lie beside each other. A motion shows in all of them, noise and a vehicle that rocks in one line or another.

A vehicle, floor or arm that creeps: its rate from two sweeps of one strip, taken out of the first one's lines.

An arm that has not moved between two sweeps sees the surface in one place, or something moves: vehicle, floor, table,
or the arm itself. The rate is taken as even; half of it is counted as unknown, as it may not be
(docs/explanation/theory.md, section 8). A placed part may still move while what is beside it does not."""

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import NDArray

from cell.measure.geometry.poses import perturbed
from cell.measure.inversion.nominal import Array, NominalSurface, Scan, correspondences
from cell.measure.inversion.observability import Tolerance, name, sorted_out
from cell.measure.inversion.part_pose import parted
from cell.measure.inversion.place_pose import PlacePose
from cell.measure.reconstruction.cloud import Cloud, Indices, Motions

GATE_M = 5e-3
"""Points farther from where the surface was are not of it; where it has moved farther, few are left."""
BESIDE_M = 1e-3
"""Between points of the two scans that are compared; more where the lines of the first one lie farther apart."""
SPREAD = 2.5
"""Of distances to the lines of a scan, which are uniform up to half of what is between two lines, the largest is twice
the median."""
OUTLIER = 5.0
"""Median absolute deviations from the motion found."""
EVIDENCE = 32.0
"""Squared Mahalanobis distance above which it has moved: 6 times F(6, 28) at 0.999, for some thirty lines. Of ten lines
that scatter by themselves 0.2 % come that far."""
NEIGHBOURS = 4
ROUNDS = 3
MOST_POINTS = 40_000
LEAST_M = 3e-6
"""Noise of a point that is believed."""
LEAST_MATCHED = 0.5
"""Share of the second scan's points beside the surface, against the first one's, above which it can be the same."""
SETTLED_M = 0.05e-3
MOST_STEPS = 8
"""Until a surface that has moved far is found where it lies now."""


@dataclass(frozen=True, eq=False)
class SurfaceMotion:
    """By what `motion` (6,) (shift m, turn rad; base axes, about the surface's origin) the surface seems to have moved.

    Its `covariance` (6, 6), and `scatter` (6, 6), the same of an arm that has not moved at all; `matched`, the share of
    the second scan's points beside the surface as it was found, in units of the first one's. `found` is where one
    that has moved lies, as `motion`; None where it was not found.
    """

    motion: Array
    covariance: Array
    matched: float
    scatter: Array
    found: Array | None = None

    @property
    def times(self) -> float:
        """How many times as far as chance takes it."""
        return float(np.sqrt(self.motion @ np.linalg.solve(self.covariance, self.motion) / EVIDENCE))

    @property
    def moved(self) -> bool:
        """Whether it has moved, or is not there any more."""
        return not (self.matched >= LEAST_MATCHED and self.times <= 1.0)

    def hidden(self, base_from_surface: pin.SE3, tolerance: Tolerance, radius: float) -> list[str]:
        """In words the motions, about the surface's axes, that would be larger than `tolerance` before they show."""
        unit = np.array([tolerance.translation] * 3 + [tolerance.rotation] * 3)
        turned = np.kron(np.eye(2), base_from_surface.rotation)
        covariance = EVIDENCE * turned.T @ self.covariance @ turned
        values, ways = np.linalg.eigh(covariance / np.outer(unit, unit))
        ways = unit[:, None] * ways[:, values > 1.0]
        return [_least(way, covariance, radius) for way in sorted_out(ways, radius)] if ways.size else []

    def as_dict(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "mm": [round(1e3 * float(v), 4) for v in self.motion[:3]],
            "mrad": [round(1e3 * float(v), 4) for v in self.motion[3:]],
            "sigma_mm": [round(1e3 * float(v), 4) for v in np.sqrt(np.diag(self.covariance))[:3]],
            "matched": round(self.matched, 3),
        }


def _least(way: Array, covariance: Array, radius: float) -> str:
    """The least motion along `way` (6,) that shows, as `covariance` (6, 6) has it, in words."""
    turn = float(np.linalg.norm(way[3:]))
    block, own, unit = (
        (slice(0, 3), way[:3], "mm") if turn * radius < np.linalg.norm(way[:3]) else (slice(3, 6), way[3:], "mrad")
    )
    own = own / np.linalg.norm(own)
    least = float(np.sqrt(own @ covariance[block, block] @ own))
    if least * (1.0 if unit == "mm" else radius) > GATE_M:
        return f"{name(way, radius)} does not show"
    return f"{name(way, radius)} shows from {1e3 * least:.2g} {unit} on"


def surface_motion(
    first: Cloud, second: Cloud, nominal: NominalSurface, pose: pin.SE3, by_poses: tuple[Motions, Motions]
) -> SurfaceMotion:
    """Between two scans of the same strip of the `nominal` surface; in the first it lay at `pose` (base_from_surface).
    `by_poses` is how the points of each scan move by one standard deviation of what the arm's poses are off by."""
    before = _Beside.of(first, nominal, pose, by_poses[0])
    tree = scipy.spatial.cKDTree(before.feet)
    seen = _compared(before, tree, _Beside.of(second, nominal, pose, by_poses[1]), nominal.radius)
    if seen.matched < LEAST_MATCHED or not seen.moved:
        return seen
    # From afar its heights tell how far it went only roughly: it is followed there.
    step, there = seen.motion, pose
    for _ in range(MOST_STEPS):
        there = pin.SE3(pin.exp3(step[3:]) @ there.rotation, there.translation + step[:3])
        if np.linalg.norm(step[:3]) + nominal.radius * np.linalg.norm(step[3:]) < SETTLED_M:
            turn = pin.log3(there.rotation @ pose.rotation.T)
            return replace(seen, found=np.concatenate([there.translation - pose.translation, turn]))
        left = _compared(before, tree, _Beside.of(second, nominal, there, by_poses[1]), nominal.radius)
        if left.matched < LEAST_MATCHED:
            break
        step = left.motion
    return seen


def _compared(before: "_Beside", tree: scipy.spatial.cKDTree, now: "_Beside", radius: float) -> SurfaceMotion:
    """How far the points of `now` have risen over those of `before`, whose feet are in the `tree`, as a motion."""
    # As far as the gate lets it be told, where the points tell nothing.
    free = np.array([GATE_M] * 3 + [GATE_M / radius] * 3)
    if not (len(now.heights) and len(before.heights) >= NEIGHBOURS):
        return SurfaceMotion(np.zeros(6), np.diag(free**2), 0.0, np.diag(free**2))
    apart, pairs = map(np.asarray, tree.query(now.feet, k=NEIGHBOURS))
    near = apart[:, -1] <= max(BESIDE_M, SPREAD * float(np.median(apart[:, -1])))
    matched = now.share * float(near.mean()) / before.share
    pairs = pairs[near]
    risen = now.heights[near] - before.heights[pairs].mean(axis=1)
    rows, lines = now.jacobian[near], now.lines[near]
    poses = np.concatenate([now.by_poses[near], before.by_poses[pairs].mean(axis=1)], axis=1)
    kept = np.ones(len(risen), dtype=np.bool_)
    motion, covariance, scatter = np.zeros(6), np.diag(free**2), np.diag(free**2)
    for _ in range(ROUNDS):
        motion, covariance, scatter = _fitted(rows[kept], risen[kept], lines[kept], poses[kept], free)
        left = risen - rows @ motion
        kept = np.abs(left) <= OUTLIER * float(np.median(np.abs(left))) + 1e-9
    return SurfaceMotion(motion, covariance, matched, scatter)


def _fitted(
    rows: Array, risen: Array, lines: NDArray[np.intp], poses: Array, free: Array
) -> tuple[Array, Array, Array]:
    """The motion (6,), its covariance (6, 6), and the same without the arm's poses, from how far points (n,) have
    `risen`, by their derivatives (n, 6).

    `free` (6,) is one standard deviation of a motion that the points tell nothing of. What is left is of single points
    and of whole `lines` (n,); the `poses` (n, m) of the arm move all of a scan.
    """
    # In units of `free`: what is told and what is not lie too far apart otherwise to be solved for together.
    scaled = rows * free
    left = risen - scaled @ np.linalg.lstsq(scaled, risen)[0]
    number = np.bincount(lines)
    means = np.bincount(lines, left) / np.maximum(number, 1)
    point = max(LEAST_M, float(np.std(left - means[lines])))
    line = float(np.sqrt(np.sum(means**2) / max(1, int(np.count_nonzero(number)) - 6)))
    covariance = np.asarray(np.linalg.inv(scaled.T @ scaled / point**2 + np.eye(6)))
    motion = covariance @ scaled.T @ risen / point**2
    by_line = line * np.stack([np.bincount(lines, column) for column in scaled.T])
    lines_spread, poses_spread = (covariance @ each / point**2 for each in (by_line, scaled.T @ poses))
    scatter = covariance + lines_spread @ lines_spread.T
    unit = np.outer(free, free)
    return free * motion, unit * (scatter + poses_spread @ poses_spread.T), unit * scatter


@dataclass(frozen=True, eq=False)
class _Beside:
    """Points of a scan that lie beside the surface: their `feet` (n, 3) on it, surface frame, `heights` (n,) over it in
    m, how the heights follow a motion of the surface, `jacobian` (n, 6), and the arm's poses, `by_poses` (n, m), their
    `lines` (n,), and the `share` of the scan that they are."""

    feet: Array
    heights: Array
    jacobian: Array
    by_poses: Array
    lines: NDArray[np.intp]
    share: float

    @classmethod
    def of(cls, cloud: Cloud, nominal: NominalSurface, pose: pin.SE3, by_poses: Motions) -> "_Beside":
        scan, (lines, rows) = Scan.of(cloud, MOST_POINTS), cloud.subsample(MOST_POINTS)
        found = correspondences(pose, scan, nominal, GATE_M)
        feet = found.arms - found.heights[:, None] * found.normals
        moved = by_poses(lines[found.index], rows[found.index])
        return cls(
            feet @ pose.rotation, found.heights, -found.jacobian,
            by_poses=np.einsum("ni,nim->nm", found.normals, moved), lines=scan.lines[found.index],
            share=len(found.index) / max(1, len(lines)),
        )  # fmt: skip


CREEP_EVIDENCE = 32.0
"""Squared Mahalanobis distance by the scatter alone from which on something creeps: as for a motion (`moved`)."""
FLOOR = np.diag([6e-6**2] * 3 + [80e-6**2] * 3)
"""What neighbouring points share in either sweep, and a scatter does not show, m² and rad²."""
LEAST_CREEP_M = 15e-6
"""Less than this at the surface, between two sweeps, is not worth a word."""
UNEVEN = 0.5
"""One standard deviation of the rate's changes, of the rate."""


@dataclass(frozen=True, eq=False)
class Creep:
    """How the surface creeps against the arm: `rate` (6,) in m/s and rad/s, base axes, about `origin` (3,) m, and its
    `covariance` (6, 6); `since` is the time, s, of the middle of the first sweep, where its place is known."""

    rate: Array
    covariance: Array
    origin: Array
    since: float

    @classmethod
    def of(cls, moved: SurfaceMotion, unsure: Array, origin: Array, since: float, until: float) -> "Creep | None":
        """From a motion between two sweeps, their middles at `since` and `until`, s; None where none shows. `unsure`
        (6, 6) is what the sweeps' times leave open of the motion."""
        seconds, covariance, motion = until - since, moved.scatter + unsure + FLOOR, moved.motion
        shown = float(motion @ np.linalg.solve(covariance, motion))
        if seconds <= 0 or shown < CREEP_EVIDENCE or np.linalg.norm(motion[:3]) < LEAST_CREEP_M:
            return None
        rate = motion / seconds
        return cls(rate, covariance / seconds**2 + UNEVEN**2 * np.outer(rate, rate), origin, since)

    def undone(self, cloud: Cloud, times: Array) -> Cloud:
        """The cloud as it would be had nothing moved since the middle of the sweep; its lines were taken at `times`."""
        rates = self.rate[:3] + np.cross(self.rate[3:], cloud.points - self.origin)
        return replace(cloud, points=cloud.points - (times - self.since)[:, None, None] * rates)

    def motions(self, cloud: Cloud, lines: Indices, rows: Indices, times: Array) -> Array:
        """(n, 3, 6) displacements in m, base axes, of the points at (lines, rows) by what is not known of the rate."""
        values, vectors = np.linalg.eigh(self.covariance)
        roots = vectors * np.sqrt(np.maximum(values, 0.0))
        arms = cloud.points[lines, rows] - self.origin
        rates = roots[:3] + np.cross(roots[3:].T[None], arms[:, None]).transpose(0, 2, 1)
        return np.asarray((times[lines] - self.since)[:, None, None] * rates)

    def carried(self, pose: PlacePose, time: float) -> PlacePose:
        """The place at `time`, s, with the covariance that the rate leaves it with."""
        seconds = time - self.since
        unknown = seconds**2 * self.covariance
        return replace(
            pose, base_from_surface=perturbed(pose.base_from_surface, seconds * self.rate),
            systematic=pose.systematic + unknown, covariance=pose.covariance + unknown,
        )  # fmt: skip

    def as_dict(self) -> dict[str, object]:
        """Figures for the journal."""
        sigma = np.sqrt(np.diag(self.covariance))
        both = (("um_s", "urad_s", self.rate), ("sigma_um_s", "sigma_urad_s", sigma))
        return {name: (1e6 * part).round(2).tolist() for a, b, v in both for name, part in ((a, v[:3]), (b, v[3:]))}

    @property
    def words(self) -> str:
        """For people."""
        shift, turn = 1e6 * np.linalg.norm(self.rate[:3]), 1e6 * np.linalg.norm(self.rate[3:])
        return (
            f"the surface creeps against the arm by {shift:.0f} µm/s and {turn:.0f} µrad/s: vehicle, floor, carriage "
            "or surface. Its place is carried on to the time of placing, and the stated uncertainty allows for it; "
            "see what the vehicle stands on"
        )


LEAST_POINTS = 500
"""Of a part or of the ground, in a sweep that tells of them."""
LEAST_MOTION_M = 30e-6
"""A part whose points move by less than this between two sweeps, on average, counts as at rest."""


@dataclass(frozen=True, eq=False)
class PartOnGround:
    """A part with these `faces`, about where it lies (`base_from_part`), and the `ground` beside it, with
    base_from_ground; None for a part that lies in a nest. What moves arm or vehicle moves both alike."""

    faces: NominalSurface
    base_from_part: pin.SE3
    ground: tuple[NominalSurface, pin.SE3] | None = None

    def moved(self, first: Cloud, second: Cloud, unsure: Array) -> float | None:
        """How far, m, the part's points moved on average between two clouds, arm base: 0 for one that lies still,
        `GATE_M` for one that is not near any more, None where the first cloud does not show it.

        `unsure` (6, 6), base axes, is by how much the clouds may lie apart for another reason: times, the arm. Ground
        beside the part tells it better.
        """
        far = self._moved_from(self.base_from_part, first, second, unsure)
        if not far:
            return far
        # One that lies mm aside seems to move, for other lines show other points of it: it is judged where it lies.
        return self._moved_from(_settled(first, self), first, second, unsure)

    def _moved_from(self, here: pin.SE3, first: Cloud, second: Cloud, unsure: Array) -> float | None:
        """As `moved`, for a part that lay `here` (base_from_part)."""
        (before, around), (now, around_now) = (parted(cloud, self.faces, here) for cloud in (first, second))
        if before.size < LEAST_POINTS:
            return None
        part = surface_motion(before, now, self.faces, here, (_nothing, _nothing))
        if part.matched < LEAST_MATCHED:
            return GATE_M
        motion = part.motion
        if self.ground is not None and around.size >= LEAST_POINTS:
            surface, there = self.ground
            ground = surface_motion(around, around_now, surface, there, (_nothing, _nothing))
            # Where the ground tells nothing, what is known beforehand stands.
            told = unsure @ np.linalg.inv(unsure + ground.scatter)
            carried = np.eye(6)
            carried[:3, 3:] = -pin.skew(here.translation - there.translation)
            motion = motion - carried @ told @ ground.motion
            unsure = carried @ (unsure - told @ unsure) @ carried.T
        if motion @ np.linalg.solve(part.scatter + FLOOR + unsure, motion) < CREEP_EVIDENCE:
            return 0.0
        points = self.faces.vertices @ here.rotation.T
        far = float(np.linalg.norm(motion[:3] + np.cross(motion[3:], points), axis=1).mean())
        return far if far > LEAST_MOTION_M else 0.0


def _settled(cloud: Cloud, part: PartOnGround) -> pin.SE3:
    """base_from_part, brought to where the cloud shows the part."""
    own, here = parted(cloud, part.faces, part.base_from_part)[0], part.base_from_part
    free = np.array([GATE_M] * 3 + [GATE_M / part.faces.radius] * 3)
    for _ in range(MOST_STEPS):
        seen = _Beside.of(own, part.faces, here, _nothing)
        if len(seen.heights) < NEIGHBOURS:
            break
        step = _fitted(seen.jacobian, seen.heights, seen.lines, seen.by_poses, free)[0]
        here = pin.SE3(pin.exp3(step[3:]) @ here.rotation, here.translation + step[:3])
    return here


def _nothing(lines: Indices, rows: Indices) -> Array:
    """The poses move no point: what they are off by moves part and ground alike."""
    return np.zeros((len(lines), 3, 0))

"""The gap between the part as drawn and the surface below it, before the one is put onto the other.

The place is told by the surface alone. A part that is drawn in another datum, of another revision, or exchanged does
not lie where its pose says, and nothing but its own underside can tell.
"""

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from cell.measure.inversion import disagreement
from cell.measure.inversion.nominal import Array, Indices, NominalSurface
from cell.measure.inversion.place_pose import PlacePose
from cell.measure.reconstruction.cloud import Cloud
from drivers.errors import Measured, RefusedError

LEAST_SEEN = 0.5
"""Share of the mating face below which its gap says little."""
SAMPLES = 40_000
DEEPEST_M = 1.5e-3
"""What was scanned farther below the drawn surface is not the surface: a table beside it, or a hole."""
FORM_M = 20e-6
"""What the form of part and surface makes of a gap, m, one standard deviation; assumed."""
FIVE_PERCENT = 1.645
"""Standard deviations that 5 % of all draws exceed."""
APART = "below the part as drawn there is nothing of the surface, or the triangles of part.mesh face inwards"
NEXT_STEP = (
    "See that part.mesh is the drawing of this part, in the datum of grasp.flange_from_part and "
    "place.surface_from_part (--grasp and --part-place of `cell new-job`), and that both are of one revision"
)


@dataclass(frozen=True, eq=False)
class MatingGap:
    """The gap between a part's mating face and the surface, in squares of 2 mm, along the part's z axis.

    `places` (n, 3) m are the squares' middles on the surface, surface frame; `gaps` (n,) m, below 0 where both
    interfere; `noise` (n,) m four standard deviations of each. `seen` is the share of the mating face with a square.
    `opening` (n, 3), surface frame, is how much each gap opens with the part's motion there, m per m.
    """

    places: Array
    gaps: Array
    noise: Array
    seen: float
    opening: Array

    @property
    def overlap(self) -> float:
        """By how much, m, both interfere in the worst square, beyond its noise; below 0 where they nowhere do."""
        return float(np.max(-self.gaps - self.noise))

    @property
    def interference(self) -> float:
        """What 5 % of the squares interfere by or more, m, beyond what noise does to as many: one alone may be dirt."""
        return float(np.percentile(-self.gaps - FIVE_PERCENT / disagreement.SIGMAS * self.noise, 95))

    @property
    def clearance(self) -> float:
        """What 98 % of the squares are apart by or more, m: more of them are nearly closed about what bears a part."""
        return float(np.percentile(self.gaps, 2))

    def _opened(self, about: Array) -> Array:
        """How much each gap opens (n, 6), m, with the part's motion, m and rad, surface axes, about a point (3,) m."""
        return np.hstack([self.opening, np.cross(self.places - about, self.opening)])

    def by_motions(self, motions: Array, about: Array, percent: float) -> float:
        """Below what, m, `interference` stays for `percent` of these motions (n, 6) of a part that just touches."""
        return float(np.percentile(np.percentile(-self._opened(about) @ motions.T, 95, axis=0), percent))

    def off_contact(self, about: Array, sigmas: Array) -> Array:
        """The motion (6,), m and rad, surface axes, about a point (3,) m, that would close all gaps: least squares with
        the prior `sigmas` (6,)."""
        rows = self._opened(about) * sigmas
        normal = rows.T @ rows + FORM_M**2 * np.eye(6)
        return np.asarray(sigmas * np.linalg.solve(normal, rows.T @ self.gaps))

    @property
    def apart(self) -> float:
        """By how much, m, they are apart in the nearest square, beyond its noise."""
        return float(np.min(self.gaps - self.noise))

    @property
    def lift(self) -> float:
        """How much higher, m, than its place the part comes to lie by this; below 0 where it lies deeper."""
        return max(0.0, self.overlap) - max(0.0, self.apart)

    def stated(self, pose: PlacePose, surface_from_part: pin.SE3) -> PlacePose:
        """The pose with what the part is off its place by in its covariance, along its z axis."""
        off = np.zeros(6)
        off[:3] = self.lift * (pose.base_from_surface.rotation @ surface_from_part.rotation[:, 2])
        more = np.outer(off, off)
        return replace(pose, systematic=pose.systematic + more, covariance=pose.covariance + more)

    @property
    def words(self) -> str:
        """For people."""
        _, middle, _ = disagreement.spread_mm(self.gaps, 2)
        return f"gap {self.span} mm, {middle:.2f} mm in the middle; {100 * self.seen:.0f} % of it seen"

    @property
    def span(self) -> str:
        """The least and the largest gap, mm, for people."""
        least, _, most = disagreement.spread_mm(self.gaps, 2)
        return f"{least:.2f} to {most:.2f}"

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, what was not looked at."""
        if self.seen >= LEAST_SEEN:
            return ()
        return (
            f"of the part's mating face {100 * self.seen:.0f} % lie over what was scanned (at least "
            f"{100 * LEAST_SEEN:.0f} % tell): whether it fits there is hardly known. Widen scan.swath or scan.length",
        )

    def as_dict(self) -> dict[str, float]:
        """For the journal."""
        return disagreement.spread_for_journal(self.gaps, self.seen)

    def measured(self, tolerance: float) -> Measured:
        """How far the part would interfere with the surface, beside what is allowed at this `tolerance`, m."""
        return Measured("part into the surface", 1e3 * self.overlap, "mm", most=1e3 * disagreement.ALLOWED * tolerance)

    def problem(self, tolerance: float) -> str | None:
        """Why the part does not fit the place of this `tolerance`, m; None where it does."""
        allowed = disagreement.ALLOWED * tolerance
        if self.overlap > allowed:
            x, y, z = 1e3 * self.places[np.argmax(-self.gaps - self.noise)]
            return (
                f"the part as drawn goes {1e3 * self.overlap:.2f} mm into the surface at ({x:.0f}, {y:.0f}, {z:.0f}) "
                f"mm. Allowed are {1e3 * allowed:.2f} mm, half of the place's tolerance. {NEXT_STEP}"
            )
        if self.apart > allowed:
            return (
                f"the part as drawn lies {1e3 * self.apart:.2f} mm or more above the surface everywhere. Allowed are "
                f"{1e3 * allowed:.2f} mm, half of the place's tolerance. {NEXT_STEP}"
            )
        return None

    def require(self, tolerance: float) -> None:
        """Raise `RefusedError` where the part does not fit the place of this `tolerance`, m."""
        if problem := self.problem(tolerance):
            raise RefusedError(f"{problem}, then run the job again", self.measured(tolerance))


def scanned_gap(
    cloud: Cloud, pose: pin.SE3, nominal: NominalSurface, surface_from_part: pin.SE3, part: NominalSurface
) -> MatingGap | None:
    """The gap below the `part` at `surface_from_part`, of a surface that was scanned and lies at base_from_surface
    `pose`. None where nothing scanned lies below the part."""
    lines, rows = np.nonzero(cloud.valid)
    local = (cloud.points[lines, rows] - pose.translation) @ pose.rotation
    return _gap(local, lines, nominal, surface_from_part, part)


def drawn_gap(nominal: NominalSurface, surface_from_part: pin.SE3, part: NominalSurface) -> MatingGap | None:
    """The gap between the two as they are drawn."""
    samples = _thinned(nominal.samples)
    return _gap(samples, np.arange(len(samples)), nominal, surface_from_part, part)


def _thinned(samples: Array) -> Array:
    return samples[:: max(1, len(samples) // SAMPLES)]


def _gap(
    points: Array, lines: Indices, nominal: NominalSurface, surface_from_part: pin.SE3, part: NominalSurface
) -> MatingGap | None:
    """Of `points` (n, 3) m of the surface, surface frame, taken in the lines (n,)."""
    # Where the drawn surface has its other side, or a wall, a part meets nothing.
    index, feet = nominal.feet(points, disagreement.REACH_M)
    up = feet.normals @ surface_from_part.rotation[:, 2] > disagreement.STEEPEST
    index = index[feet.inner & up & (feet.heights > -DEEPEST_M)]
    below = (points[index] - surface_from_part.translation) @ surface_from_part.rotation
    over, feet = part.feet(below, disagreement.REACH_M)
    down = -feet.normals[:, 2]
    mates = feet.inner & (down > disagreement.STEEPEST)
    if not mates.any():
        return None
    over, gaps = over[mates], feet.heights[mates] / down[mates]
    medians, middle, noise = disagreement.squares(disagreement.square_of(below[over]), gaps, lines[index[over]])
    if not len(medians):
        return None
    face = _mating_face(nominal, surface_from_part, part)
    seen = np.isin(face, np.unique(disagreement.square_of(below[over[medians]]))).mean() if len(face) else 0.0
    opening = (feet.normals[mates] / feet.normals[mates, 2:])[medians] @ surface_from_part.rotation.T
    return MatingGap(points[index[over[medians]]], middle, noise, float(seen), opening)


def _mating_face(nominal: NominalSurface, surface_from_part: pin.SE3, part: NominalSurface) -> Indices:
    """The squares of the part's underside that have the drawn surface below them."""
    facing = part.normals[part.sample_triangles][:, 2] < -disagreement.STEEPEST
    under = _thinned(part.samples[facing])
    found, feet = nominal.feet(
        under @ surface_from_part.rotation.T + surface_from_part.translation, disagreement.REACH_M
    )
    return np.unique(disagreement.square_of(under[found[feet.inner]]))

"""A vehicle, floor or arm that creeps: its rate from two sweeps of one strip, taken out of the first one's lines.

An arm that has not moved between two sweeps sees the surface in one place, or something moves: vehicle, floor, table,
or the arm itself. The rate is taken as even; half of it is counted as unknown, as it may not be
(docs/explanation/theory.md, section 8).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.measure.geometry.poses import perturbed
from cell.measure.inversion.closest import Array
from cell.measure.inversion.effects.moved import SurfaceMotion
from cell.measure.inversion.place_pose import PlacePose
from cell.measure.reconstruction.cloud import Cloud, Indices

EVIDENCE = 32.0
"""Squared Mahalanobis distance by the scatter alone from which on something creeps: as for a motion (`moved`)."""
FLOOR = np.diag([6e-6**2] * 3 + [80e-6**2] * 3)
"""What neighbouring points share in either sweep, and a scatter does not show, m² and rad²."""
LEAST_M = 15e-6
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
    def of(cls, moved: SurfaceMotion, unsure: Array, origin: Array, since: float, until: float) -> Creep | None:
        """From a motion between two sweeps, their middles at `since` and `until`, s; None where none shows.

        `unsure` (6, 6) is what the sweeps' times leave open of the motion.
        """
        seconds, covariance, motion = until - since, moved.scatter + unsure + FLOOR, moved.motion
        shown = float(motion @ np.linalg.solve(covariance, motion))
        if seconds <= 0 or shown < EVIDENCE or np.linalg.norm(motion[:3]) < LEAST_M:
            return None
        rate = motion / seconds
        return cls(rate, covariance / seconds**2 + UNEVEN**2 * np.outer(rate, rate), origin, since)

    def undone(self, cloud: Cloud, times: Array) -> Cloud:
        """The cloud as it would be had nothing moved since the middle of the sweep; its lines were taken at `times`."""
        arms = cloud.points - self.origin
        rates = self.rate[:3] + np.cross(self.rate[3:], arms)
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
            pose,
            base_from_surface=perturbed(pose.base_from_surface, seconds * self.rate),
            systematic=pose.systematic + unknown,
            covariance=pose.covariance + unknown,
        )

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

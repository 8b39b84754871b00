"""How the part is held, and how it comes to lie: what a correction leaves, and what the parts of a batch have alike.

A worn finger, or parts that lie askew where they are loaded, bring each part of a batch as far aside as the one before:
so much the next is put down to the other side.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from cell.config.job import GraspSection, Job
from cell.measure.geometry.poses import composition_jacobians, from_parts, transform
from cell.measure.inversion import PlacePose
from cell.procedures.part_error import draws_of
from drivers.interfaces import Vector
from drivers.make import Mounting

GRIPPED = np.diag([20e-6**2] * 3 + [0.2e-3**2] * 3)
"""Covariance of how a claw that closes on a part where it let it go moves it, m² and rad²: stated, as the grasp is."""
SLIPS = 2.0
"""A part slips as the claw opens where it moves so many times as far as a correction leaves it off, on average."""
FARTHEST_M = 2e-3
"""A part that lies farther aside is neither gripped, since the fingers may not find it, nor allowed for."""
NEWEST = 10
"""So many parts of a batch tell how the next one will come to lie."""
ALIKE = 0.5
"""Parts came to lie alike where they differ from their median by at most this share of it, on average."""


def job_with_grasp(job: Job, flange_from_part: pin.SE3, seen: Vector) -> Job:
    """The job with its part held at `flange_from_part`, known to `seen` (6, 6)."""
    roll, pitch, yaw = pin.rpy.matrixToRpy(flange_from_part.rotation)
    x, y, z = flange_from_part.translation
    sigmas = np.sqrt(np.diag(seen + GRIPPED))
    held = Mounting.model_construct(translation=(x, y, z), rotation=(roll, pitch, yaw))
    grasp = GraspSection.model_construct(
        flange_from_part=held, size=job.grasp.size, sigma=float(sigmas[:3].max()), sigma_angle=float(sigmas[3:].max())
    )
    return job.model_copy(update={"grasp": grasp})


def expected_residual(
    job: Job, repeatability: Vector, pose: PlacePose, points: Vector, seen: Vector, *, corrections: int = 1
) -> float:  # fmt: skip
    """How far along the surface, m, the part's `points` (n, 3), part frame, lie off their places on average after up to
    so many corrections: from the arm's `repeatability` (6, 6), and what is not known of the part where it was `seen`,
    (6, 6), surface axes."""
    belongs = job.place.surface_from_part.se3()
    base_from_part = pose.base_from_surface * belongs
    flange = base_from_part * job.grasp.flange_from_part.se3().inverse()
    carried = composition_jacobians(flange, flange.inverse() * base_from_part)[0]
    turn = np.kron(np.eye(2), pose.base_from_surface.rotation.T)
    # It comes to rest twice: where it grips, and where it lets go.
    rests = turn @ carried @ (2.0 * repeatability) @ carried.T @ turn.T
    x, y, _, about_x, about_y, about_z = draws_of(rests + seen + GRIPPED).T[..., None]
    levers = points @ belongs.rotation.T
    along = x + about_y * levers[:, 2] - about_z * levers[:, 1], y + about_z * levers[:, 0] - about_x * levers[:, 2]
    return best_expected(np.hypot(*along).mean(axis=1), corrections)


def best_expected(drawn: Vector, corrections: int) -> float:
    """The mean after up to so many `corrections`, of which each leaves one of `drawn` (n,), and which end as soon as
    those left promise no less: the optimal stopping of a search without recall."""
    best = float(drawn.mean())
    for _ in range(corrections - 1):
        best = float(np.minimum(drawn, best).mean())
    return best


def moved(motion: pin.SE3, points: Vector) -> float:
    """How far a motion of the part, its own frame, moves its `points` (n, 3), on average, m."""
    return float(np.linalg.norm(transform(motion, points) - points, axis=1).mean())


@dataclass(frozen=True, eq=False)
class GraspSeries:
    """How the newest parts of a batch came to lie along the surface: x and y in m and the turn in rad, part frame, from
    where the part belongs to where it was seen.

    `aside` (n, 3) when first put down, had nothing been allowed for. `opening` (m, 3) as the claw opened over parts
    that were placed again, of which it was seen before how they were held.
    """

    aside: Vector = field(default_factory=lambda: np.zeros((0, 3)))
    opening: Vector = field(default_factory=lambda: np.zeros((0, 3)))

    def after(self, came: pin.SE3, slips: Sequence[pin.SE3]) -> "GraspSeries":
        """With one part more, which first `came` to lie so, and in its corrections by `slips`."""
        opening = [self.opening, *map(_row, slips)]
        return GraspSeries(np.vstack([self.aside, _row(came)])[-NEWEST:], np.vstack(opening)[-NEWEST:])

    def allowance(self, points: Vector, noise: float) -> pin.SE3 | None:
        """What is to be allowed for when the next part is put down; None where the parts tell nothing.

        `points` (n, 3), part frame, are those by which a part is judged; `noise` is how far off, m, they are on average
        where nothing but the arm errs.
        """
        return _alike(self.aside, points, noise)

    def slip(self, points: Vector, noise: float) -> pin.SE3 | None:
        """How a part moves as the claw opens over it, the identity for not at all; None where the parts do not tell."""
        return None if len(self.opening) < 2 else _alike(self.opening, points, noise) or pin.SE3.Identity()


def _alike(rows: Vector, points: Vector, noise: float) -> pin.SE3 | None:
    """The median of motions that are alike and no chance. It takes two: one part may have been bumped."""
    if len(rows) < 2:
        return None
    found = _motion(*np.median(rows, axis=0))
    far = moved(found, points)
    apart = np.mean([moved(found.inverse() * _motion(*row), points) for row in rows])
    clear = SLIPS * noise / np.sqrt(len(rows)) <= far < FARTHEST_M
    return found if clear and apart <= ALIKE * far else None


def _row(motion: pin.SE3) -> Vector:
    x, y, _ = motion.translation
    return np.array([x, y, pin.log3(motion.rotation)[2]])


def _motion(x: float, y: float, turn: float) -> pin.SE3:
    return from_parts((x, y, 0.0), pin.exp3(np.array([0.0, 0.0, turn])))

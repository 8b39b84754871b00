"""First touch: where the part met the ground as the arm felt it, against where the scan says that it would.

Nothing else tells what went wrong after the scan: a laser that turned, an arm that sags, a part that slipped.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.config.job import Job
from cell.measure.inversion import NominalSurface, PlacePose
from cell.procedures.part_error import part_covariance
from drivers.errors import Measured, RefusedError
from drivers.interfaces import ArmState, Vector

REFUSED, NOTED = 3.5, 2.5
"""Standard deviations between felt and expected touch. Normal errors go beyond them in 0.05 % and 1.2 % of all jobs."""
FELT_M = 30e-6
"""One standard deviation of what a force that is told late, dust and the form of part and surface do to the touch."""
LEAST_STATES = 20
LEAST_FORCE_N = 0.01
"""No force is told finer."""
LONGEST_FOLLOWS = 0.99
"""Correlation of the errors of two readings, one after the other, at most."""
STEEPEST = 0.3
"""Cosine of the slope beyond which a wall is no ground to touch."""
GRID_M = 5e-6
"""Steps in which the touch is looked for."""
MOST_STATES = 400
DRAWS = 1000
UNDERSIDE = 400
"""So many points of the underside are looked at for the first touch."""


@dataclass(frozen=True)
class TouchHeight:
    """A height of the part above its place along the surface's normal, m, and one standard deviation of it."""

    height: float
    sigma: float


@dataclass(frozen=True)
class TouchCheck:
    """Where the part touched as `felt`, and where it was `expected` to."""

    felt: TouchHeight
    expected: TouchHeight

    @property
    def off(self) -> float:
        """How much higher than expected it touched, m."""
        return self.felt.height - self.expected.height

    @property
    def sigma(self) -> float:
        """One standard deviation of `off`."""
        return float(np.hypot(self.felt.sigma, self.expected.sigma))

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, when it is more than chance often brings."""
        if abs(self.off) <= NOTED * self.sigma:
            return ()
        return (f"{self._words}; look at the part, and run `cell calibrate verify` before the next job",)

    @property
    def measured(self) -> Measured:
        """`off` beside the most that is allowed."""
        most = 1e3 * REFUSED * self.sigma
        return Measured("first touch, off what the scan says", 1e3 * self.off, "mm", most=most)

    def require(self) -> None:
        """Raise `RefusedError` when the touch contradicts what was stated of the place."""
        most = REFUSED * self.sigma
        if abs(self.off) <= most:
            return
        raise RefusedError(
            f"{self._words}, more than the allowed {1e3 * most:.3f} mm: the surface is not where the scan has it, or "
            "the part does not sit in the claw as grasp.flange_from_part and grasp.sigma say, or is another one. It "
            "was lifted again, still held. Look at it, how it sits and what lies on the place, run "
            "`cell calibrate verify`, then the job again",
            self.measured,
        )

    def as_dict(self) -> dict[str, float]:
        """For the journal."""
        return {
            "felt_mm": round(1e3 * self.felt.height, 4), "expected_mm": round(1e3 * self.expected.height, 4),
            "off_mm": round(1e3 * self.off, 4), "sigma_mm": round(1e3 * self.sigma, 4),
        }  # fmt: skip

    @property
    def _words(self) -> str:
        side = "higher" if self.off > 0 else "lower"
        return (
            f"the part touched {1e3 * abs(self.off):.3f} mm {side} than the scan says, where {1e3 * self.sigma:.3f} mm "
            "is one standard deviation"
        )


def expected_touch(job: Job, nominal: NominalSurface, pose: PlacePose, placing: Vector) -> TouchHeight:
    """Where the part touches first with all that is stated: of the pose, of the grasp, and (`placing`, (6, 6), base
    axes) of the flange each time the arm comes to rest.

    A tilted part touches with an edge before it is down. Where its force then seems to begin lies between that touch,
    of stiff bodies, and the mean height of all its points, of soft ones: both are allowed for.
    """
    values, vectors = np.linalg.eigh(part_covariance(job, pose, placing))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    steps = np.random.default_rng(0).standard_normal((DRAWS, 6)) @ root.T
    every = max(1, len(nominal.samples) // UNDERSIDE)
    normals = nominal.normals[nominal.sample_triangles[::every]]
    rise = normals @ job.place.surface_from_part.se3().rotation[:, 2]
    ground = rise > STEEPEST
    if not ground.any():
        raise RefusedError(
            "the surface is steeper everywhere than the part could be set down on, seen along the part's z axis; "
            "correct place.surface_from_part or the surface's mesh"
        )
    # Each point's way to the ground, down the part's axis, where the part is displaced by d: n·d / n·up.
    slopes = normals[ground] / rise[ground, None]
    arms = nominal.samples[::every][ground] - job.place.surface_from_part.se3().translation
    gaps = steps[:, :3] @ slopes.T + steps[:, 3:] @ np.cross(arms, slopes).T
    heights = -np.concatenate([gaps.min(axis=1), gaps.mean(axis=1)])
    return TouchHeight(float(heights.mean()), float(heights.std()))


def felt_touch(states: Sequence[ArmState], origin: Vector, normal: Vector) -> TouchHeight | None:
    """Where the force began, from the `states` of a guarded descent; None from too few of them, or too short a way.

    Heights are those of the flange over `origin` (3,), m, along `normal` (3,), which points up from the surface, both
    in base axes. The force is taken to grow with the way beyond the touch and with its square, as it does whatever of
    part, surface and arm gives way, flat or on an edge.
    """
    chosen = states[:: max(1, len(states) // MOST_STATES)]
    if len(chosen) < LEAST_STATES:
        return None
    heights = np.array([state.flange[:3] - origin for state in chosen]) @ normal
    forces = np.array([state.wrench[:3] for state in chosen]) @ normal
    tried = np.arange(heights.min(), heights.max(), GRID_M)
    if len(tried) < LEAST_STATES:
        return None
    left = np.array([np.sum(_left(heights, forces, touch) ** 2) for touch in tried])
    best = int(np.argmin(left))
    # How fast the squares grow away from the best tells how far off the touch may be.
    noise = max(float(left[best]) / (len(heights) - 4), LEAST_FORCE_N**2) * _repeats(
        _left(heights, forces, float(tried[best]))
    )
    weights = np.exp(-0.5 * (left - left[best]) / noise)
    mean = float(weights @ tried / weights.sum())
    spread = float(weights @ (tried - mean) ** 2 / weights.sum())
    return TouchHeight(mean, float(np.sqrt(spread + FELT_M**2)))


def _repeats(left: Vector) -> float:
    """So many readings one after the other say what one does: friction and a filtered sensor hold their errors on."""
    scale = float(left @ left)
    # What was fitted takes some of it out: four numbers, each of which looks like one swing the other way.
    follows = float(left[1:] @ left[:-1]) / scale + 4 / len(left) if scale > 0 else 0.0
    follows = min(max(follows, 0.0), LONGEST_FOLLOWS)
    return (1 + follows) / (1 - follows)


def _left(heights: Vector, forces: Vector, touch: float) -> Vector:
    """The force (n,), N, that one which begins at this touch leaves."""
    beyond = np.maximum(0.0, touch - heights)
    columns = np.column_stack([np.ones(len(beyond)), beyond, beyond**2])
    scale = np.maximum(np.abs(columns).max(axis=0), 1e-12)
    found = np.linalg.lstsq(columns / scale, forces, rcond=None)[0]
    return np.asarray(forces - columns / scale @ found)

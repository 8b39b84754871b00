"""Where the part touched first, by force and torque, beside where it can touch at all.

One force at a point p turns the flange by p × F. So both tell the line along which the contact pushes, and with it the
place on the underside. A contact that pushes from elsewhere is none of the part's: a claw, a cable, a wrong part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from cell.measure.inversion.nominal import Array
from drivers.errors import Measured, RefusedError

LEVEL = 1e-4
"""Of so many normal contacts at most one is refused."""
LIMIT = float(np.sqrt(-2.0 * np.log(LEVEL)))
"""Standard deviations, in a plane, that a share LEVEL of all errors exceeds: exp(-LIMIT²/2)."""
LARGEST_SHARE = 1 / 3
"""Of the part's width: a place that is known no better tells nothing."""
CROSS_TALK = 0.01
"""Share of a force that a sensor shows along its other axes, 1 sigma; assumed."""
FRICTION = 0.5
"""Of dry metal, at most: so far a contact pushes beside its normal."""
LEAST_UP = 0.2
"""Share of a force that has to push along the part's axis: else it comes from the side."""
LEAST_READINGS = 10
LONGEST_FOLLOWS = 0.99
"""Correlation of the errors of two readings, one after the other, at most."""
AROUND = np.array([[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4])


@dataclass(frozen=True, eq=False)
class ContactPoint:
    """Where the line of the contact's force crosses the underside: `place` (2,), x and y in the part's frame, m.

    `covariance` (2, 2) m² is its own. `beside` is how far, m, it lies outside of where the part can touch, `chance`
    that errors alone put a normal contact so far out. `width` m is the part's there.
    """

    place: Array
    covariance: Array
    beside: float = 0.0
    chance: float = 1.0
    width: float = np.inf

    @property
    def sigma(self) -> float:
        """One standard deviation along the axis that is known least, m."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    @property
    def judged(self) -> bool:
        """Whether the place is known well enough to say something."""
        return self.sigma <= LARGEST_SHARE * self.width

    @property
    def words(self) -> str:
        """For people."""
        x, y = 1e3 * self.place
        return f"x {x:+.0f}, y {y:+.0f} mm of the part's frame (± {2e3 * self.sigma:.0f} mm)"

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, where it tells nothing."""
        if self.judged:
            return ()
        most = 1e3 * LARGEST_SHARE * self.width
        return (
            f"where the part touched is known to {1e3 * self.sigma:.0f} mm (1 sigma, at most {most:.0f} mm tell): it "
            "was not held against the part's face. A larger place.contact_force tells more",
        )

    @property
    def measured(self) -> Measured:
        """How far outside it lies, beside the most that errors explain."""
        return Measured("first touch, beside the part's face", 1e3 * self.beside, "mm", most=1e3 * LIMIT * self.sigma)

    def require(self) -> None:
        """Raise `RefusedError` where the part cannot touch there."""
        if not self.judged or self.chance >= LEVEL:
            return
        raise RefusedError(
            f"something pushes at {self.words}, {1e3 * self.beside:.0f} mm beside where the part can touch. Errors "
            f"alone do that in {self.chance:.0e} of all jobs (allowed: {LEVEL:g}). The part was lifted again, still "
            "held. Look for a chip or burr there, a tilted or wrong part, and what claw, scan head and cables touch",
            self.measured,
        )

    def as_dict(self) -> dict[str, object]:
        """For the journal."""
        x, y = (round(1e3 * float(v), 2) for v in self.place)
        told: dict[str, object] = {"x_mm": x, "y_mm": y, "sigma_mm": round(1e3 * self.sigma, 2), "judged": self.judged}
        return told | {"beside_mm": round(1e3 * self.beside, 2), "chance": float(f"{self.chance:.2g}")}


@dataclass(frozen=True, eq=False)
class ContactRegion:
    """Where a part can touch, from n points of its mating face.

    `crossings` (n, 2) m is where a force along each point's normal crosses the plane at height `level`, m, part frame;
    `spread` (n,) m how far friction and the way to the next point move it. `clearances` (k, n) m are the ways to the
    ground under k draws of the place, `slack` (n,) m their noise, infinite where the ground was not seen.
    """

    crossings: Array
    spread: Array
    level: float
    clearances: Array
    slack: Array

    def outline(self, pressed: float) -> Array:
        """Corners (m, 2), m, of the region for a part that went on by `pressed`, m, after its first touch.

        Forces that push add up to one that lies between them: contacts at any of the points never leave the region.
        """
        seen = np.isfinite(self.slack)
        may = ~seen
        if seen.any():
            low, slack = self.clearances[:, seen], self.slack[seen]
            ground = (low + slack).min(axis=1, keepdims=True) + pressed
            may[seen] = (low - slack <= ground).any(axis=0)
        around = self.crossings[may, None] + self.spread[may, None, None] * AROUND
        flat = around.reshape(-1, 2)
        return np.asarray(flat[scipy.spatial.ConvexHull(flat).vertices])

    def judge(self, point: ContactPoint, pressed: float) -> ContactPoint:
        """The point with how far it lies outside, in m and by chance.

        A normal contact lies in the region, and what is measured no nearer to it than to that: errors put a share of
        exp(-d²/2) farther than d standard deviations outside, or less.
        """
        corners = self.outline(pressed)
        white = np.linalg.inv(np.linalg.cholesky(point.covariance))
        nearest = _nearest(corners @ white.T, white @ point.place)
        off = float(np.linalg.norm(white @ point.place - nearest))
        beside = float(np.linalg.norm(point.place - np.linalg.solve(white, nearest)))
        width = float(np.ptp(corners, axis=0).min())
        return ContactPoint(point.place, point.covariance, beside, float(np.exp(-0.5 * off**2)), width)


def _nearest(corners: Array, point: Array) -> Array:
    """The point (2,) of a convex polygon, `corners` (m, 2) in order, either way round, that is nearest to `point`."""
    sides = np.roll(corners, -1, axis=0) - corners
    to = point - corners
    turned = sides[:, 0] * to[:, 1] - sides[:, 1] * to[:, 0]
    if (turned >= 0).all() or (turned <= 0).all():
        return point
    share = np.clip((to * sides).sum(axis=1) / (sides**2).sum(axis=1), 0.0, 1.0)
    feet = corners + share[:, None] * sides
    return np.asarray(feet[np.argmin(np.linalg.norm(feet - point, axis=1))])


def contact_point(before: Array, after: Array, origin: Array, level: float, held: Array) -> ContactPoint | None:
    """Where a contact pushes, from wrenches `before` (n, 6) and `after` (m, 6) the touch, N and Nm, part axes.

    They count at the flange, which is at `origin` (3,), m, part frame. The underside is at the height `level` there.
    `held` (2, 2) m² is the covariance of the part in the claw. None from too few readings; `RefusedError` where the
    force comes from the side. A wrench may have all signs the other way round: arms differ in whose force they tell.
    """
    if min(len(before), len(after)) < LEAST_READINGS:
        return None
    (bare, noise), (pressed, more) = _averaged(before), _averaged(after)
    (fx, fy, fz, tx, ty, _), down = pressed - bare, level - origin[2]
    force = float(np.linalg.norm([fx, fy, fz]))
    if not abs(fz) > LEAST_UP * force:
        raise RefusedError(
            f"a force of {force:.1f} N pushes from the side: {abs(fz):.1f} N of it along the part's axis (a contact "
            f"below it has at least {LEAST_UP * force:.1f} N). The part was lifted again, still held. Look what claw, "
            "scan head and cables touch, and whether the part jams at a wall"
        )
    x, y = (down * fx - ty) / fz, (down * fy + tx) / fz
    by_wrench = np.array([[down, 0.0, -x, 0.0, -1.0, 0.0], [0.0, down, -y, 1.0, 0.0, 0.0]]) / fz
    wrench = noise + more + np.diag([(CROSS_TALK * force) ** 2] * 3 + [0.0] * 3)
    return ContactPoint(origin[:2] + np.array([x, y]), by_wrench @ wrench @ by_wrench.T + held)


def _averaged(wrenches: Array) -> tuple[Array, Array]:
    """Mean (6,) of readings (n, 6), and its covariance (6, 6)."""
    mean = wrenches.mean(axis=0)
    left = wrenches - mean
    alike = max(repeats(column) for column in left.T)
    return mean, np.asarray(alike * left.T @ left / (len(left) * (len(left) - 1)))


def repeats(left: Array, fitted: int = 1) -> float:
    """So many readings one after the other say what one does: friction and a filtered sensor hold their errors on.

    `left` (n,) is what a fit of so many numbers, `fitted`, left of them.
    """
    scale = float(left @ left)
    # What was fitted takes some of it out: numbers each of which looks like one swing the other way.
    follows = float(left[1:] @ left[:-1]) / scale + fitted / len(left) if scale > 0 else 0.0
    follows = min(max(follows, 0.0), LONGEST_FOLLOWS)
    return (1 + follows) / (1 - follows)

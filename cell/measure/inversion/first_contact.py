"""Where the part touched first, by force and torque, beside where it can touch at all.

One force at a point p turns the flange by p × F. So both tell the line along which the contact pushes, and with it the
place on the underside. A contact that pushes from elsewhere is none of the part's: a claw, a cable, a wrong part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.measure.inversion.nominal import Array
from drivers.errors import Measured, RefusedError

LEVEL = 1e-4
"""Of so many normal contacts at most one is refused."""
LIMIT = float(np.sqrt(-2.0 * np.log(LEVEL)))
"""Standard deviations, in a plane, that a share LEVEL of all errors exceeds: exp(-LIMIT²/2)."""
CROSS_TALK = 0.01
"""Share of a force that a sensor shows along its other axes, 1 sigma; assumed."""
FRICTION = 0.5
"""Of dry metal, at most: so far a contact pushes beside its normal."""
LEAST_UP = 0.2
"""Share of a force that pushes along the part's axis, at least: else it comes from the side."""
LEAST_READINGS = 10
LONGEST_FOLLOWS = 0.99
"""Correlation of the errors of two readings, one after the other, at most."""
AROUND = np.array([[np.cos(a), np.sin(a)] for a in np.radians(range(360))])


@dataclass(frozen=True, eq=False)
class ContactPoint:
    """Where the contact's force crosses the underside: `place` (2,), x and y in the part's frame, m.

    `covariance` (2, 2) m². `beside` is how far, m, it lies outside of where the part can touch, `chance` that errors
    alone put a normal contact so far out. `width` m is the part's.
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
        """Whether the place is known to a third of the part's width: else it tells nothing."""
        return self.sigma <= self.width / 3

    @property
    def words(self) -> str:
        """For people."""
        x, y = 1e3 * self.place
        return f"x {x:+.0f}, y {y:+.0f} mm of the part's frame (± {2e3 * self.sigma:.0f} mm)"

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, where it tells nothing."""
        told = f"{1e3 * self.sigma:.0f} mm (1 sigma) only: it was not judged. A larger place.contact_force tells more"
        return () if self.judged else (f"where the part touched is known to {told}",)

    def require(self) -> None:
        """Raise `RefusedError` where the part cannot touch there."""
        if not self.judged or self.chance >= LEVEL:
            return
        raise RefusedError(
            f"something pushes at {self.words}, {1e3 * self.beside:.0f} mm beside where the part can touch: errors do "
            f"that in {self.chance:.0e} of all jobs, allowed are {LEVEL:g}. The part was lifted again, still held. "
            "Look for a chip or burr there, a tilted or wrong part, and what claw, scan head and cables touch",
            Measured("contact, beside the part", 1e3 * self.beside, "mm", most=1e3 * LIMIT * self.sigma),
        )

    def as_dict(self) -> dict[str, object]:
        """For the journal."""
        far = {"x_mm": self.place[0], "y_mm": self.place[1], "sigma_mm": self.sigma, "beside_mm": self.beside}
        told = {name: round(1e3 * float(value), 2) for name, value in far.items()}
        return {**told, "chance": float(f"{self.chance:.2g}"), "judged": self.judged}


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

    def reach(self, ways: Array, pressed: float) -> Array:
        """How far (m,) it reaches along `ways` (m, 2), of a part that went on by `pressed`, m, after its touch."""
        ground = (self.clearances + self.slack).min(axis=1, keepdims=True) + pressed
        may = (self.clearances - self.slack <= ground).any(axis=0)
        far = self.crossings[may] @ ways.T + self.spread[may, None] * np.linalg.norm(ways, axis=1)
        return np.asarray(far.max(axis=0))

    def judge(self, point: ContactPoint, pressed: float) -> ContactPoint:
        """The point with how far it lies outside: errors put a share of exp(-d²/2) at most farther than d sigma."""
        reach = self.reach(AROUND, pressed)
        beside = max(0.0, float((AROUND @ point.place - reach).max()))
        ways = AROUND @ np.linalg.inv(np.linalg.cholesky(point.covariance))
        off = max(0.0, float((ways @ point.place - self.reach(ways, pressed)).max()))
        width = float((reach + np.roll(reach, len(AROUND) // 2)).min())
        return replace(point, beside=beside, chance=float(np.exp(-0.5 * off**2)), width=width)


def contact_point(before: Array, after: Array, origin: Array, level: float, held: Array) -> ContactPoint | None:
    """Where a contact pushes, from wrenches `before` (n, 6) and `after` (m, 6) the touch, N and Nm, part axes.

    They count at the flange, which is at `origin` (3,), m, part frame. The underside is at the height `level` there.
    `held` (2, 2) m² is the covariance of the part in the claw. None from too few readings. All signs of a wrench
    may be the other way round: arms differ in whose force they tell.
    """
    if min(len(before), len(after)) < LEAST_READINGS:
        return None
    (bare, noise), (pressed, more) = _averaged(before), _averaged(after)
    (fx, fy, fz, tx, ty, _), down = pressed - bare, level - origin[2]
    force = float(np.linalg.norm([fx, fy, fz]))
    # One from the side, above the part, is then far beside it.
    fz = np.copysign(max(abs(fz), LEAST_UP * force), fz)
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
    """So many readings one after the other say what one does: friction and a filtered sensor hold their errors on."""
    scale = float(left @ left)
    # What was fitted takes some of it out: numbers each of which looks like one swing the other way.
    follows = float(left[1:] @ left[:-1]) / scale + fitted / len(left) if scale > 0 else 0.0
    follows = min(max(follows, 0.0), LONGEST_FOLLOWS)
    return (1 + follows) / (1 - follows)

"""Flush: how much higher than drawn a placed part stands over the surface beside its edge, in one sweep of both.

The part's pose says how it lies as a whole. Along its edge each piece is held against what lies beside that piece, so a
part or a surface that is bent shows, too.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import scipy

from cell.measure.geometry.poses import transform
from cell.measure.inversion.disagreement import REACH_M, STEEPEST, spread_for_journal, spread_mm, square_of, squares
from cell.measure.inversion.nominal import Array, Indices, NominalSurface
from cell.measure.reconstruction.cloud import Cloud

UPRIGHT_M = 0.5e-3
"""So far at most is a point, moved down or up by what it is higher, from what is drawn there."""
BESIDE_M = 6e-3
"""A piece of the edge is held against what lies nearer than this."""
NOISY = 0.5
"""A piece whose noise is more than this share of the tolerance shows a wall, or several things: it says nothing."""
LEAST_SEEN = 0.5
"""Share of the pieces below which little is known of the edge."""


@dataclass(frozen=True, eq=False)
class Flush:
    """Pieces of 2 mm along a part's edge: their middles `places` (n, 3) m, surface frame, how much `higher` (n,) m than
    drawn each stands over the surface beside it, along the surface's z axis, and four standard deviations, `noise`.

    `seen` is the share of the pieces that say so, of those that have the surface beside them.
    """

    places: Array
    higher: Array
    noise: Array
    seen: float = 1.0

    @property
    def span(self) -> str:
        """The least and the largest, mm, for people."""
        least, _, most = spread_mm(self.higher, 2)
        return f"{least:+.2f} to {most:+.2f}"

    @property
    def beyond(self) -> float:
        """How far the worst piece is off what is drawn, up or down, beyond its noise, mm; below 0 within it."""
        return 1e3 * float(np.max(np.abs(self.higher) - self.noise))

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, what was not looked at."""
        if self.seen >= LEAST_SEEN:
            return ()
        return (
            f"of the edge of the placed part {100 * self.seen:.0f} % say how flush it is: look along the rest of it",
        )

    def as_dict(self) -> dict[str, float]:
        """For the journal."""
        return spread_for_journal(self.higher, self.seen)


def flush_along_edge(
    part: Cloud, beside: Cloud, base_from_surface: pin.SE3, *, nominal: NominalSurface, faces: NominalSurface,
    belongs: pin.SE3, lies: pin.SE3, tolerance: float, rocks: float = 0.0,
) -> Flush | None:  # fmt: skip
    """The flush of a part with these `faces`, which `belongs` at one surface_from_part, and `lies` at another.

    `part` and `beside` are what one sweep shows of the part and of what lies beside it, arm base; there the surface is
    at `base_from_surface`. Pieces are noisy by the place's `tolerance`, m. The vehicle `rocks` by so much, m, up and
    down: a piece and what is beside it may be swept at opposite ends of that. None where none says anything.
    """
    own = _standing(part, base_from_surface, lies, faces)
    other = _standing(beside, base_from_surface, pin.SE3.Identity(), nominal)
    if own is None or other is None:
        return None
    nearest, which = map(np.asarray, scipy.spatial.cKDTree(other.places[:, :2]).query(own.places[:, :2]))
    edge = nearest <= BESIDE_M
    noise = np.hypot(own.noise, other.noise[which]) + 2.0 * rocks
    clear = edge & (noise <= NOISY * tolerance)
    if not clear.any():
        return None
    # What a part moved to the side has higher on a slope is no step: as a whole it is higher by how its pose lifts it.
    places = own.places[clear]
    lifted = (places - transform(belongs * lies.inverse(), places))[:, 2]
    higher = own.higher[clear] + lifted - other.higher[which[clear]]
    return Flush(places, higher, noise[clear], float(clear.sum() / edge.sum()))


class PointHeights(NamedTuple):
    """Points at `places` (n, 3) m, surface frame, stand `higher` (n,) m than drawn, and come from `lines` (n,)."""

    places: Array
    higher: Array
    lines: Indices


class _Squares(NamedTuple):
    """By how much the squares at `places` (n, 3) m, surface frame, stand `higher` (n,) m than drawn, with `noise`."""

    places: Array
    higher: Array
    noise: Array


def _standing(
    cloud: Cloud, base_from_surface: pin.SE3, surface_from_it: pin.SE3, drawn: NominalSurface
) -> _Squares | None:
    """How much higher than `drawn` its points in the cloud stand, in squares of 2 mm of the surface; None for none."""
    places, higher, lines = heights_over(cloud, base_from_surface, surface_from_it, drawn)
    if not len(places):
        return None
    medians, higher, noise = squares(square_of(places), higher, lines)
    return _Squares(places[medians], higher, noise) if len(medians) else None


def heights_over(
    cloud: Cloud, base_from_surface: pin.SE3, surface_from_it: pin.SE3, drawn: NominalSurface
) -> PointHeights:
    """How much higher than `drawn`, which lies at `surface_from_it`, its points in the cloud, arm base, stand."""
    lines, rows = np.nonzero(cloud.valid)
    places = (cloud.points[lines, rows] - base_from_surface.translation) @ base_from_surface.rotation
    index, feet = drawn.feet((places - surface_from_it.translation) @ surface_from_it.rotation, REACH_M)
    up = feet.normals @ surface_from_it.rotation[2]
    kept = feet.inner & (up > STEEPEST)
    index, higher = index[kept], feet.heights[kept] / up[kept]
    # A point of the part's side is below the rim of its top. Where that slopes, its foot lies well inside of the rim.
    upright = places[index] - np.outer(higher, [0.0, 0.0, 1.0])
    near, feet = drawn.feet((upright - surface_from_it.translation) @ surface_from_it.rotation, UPRIGHT_M)
    index, higher = index[near][feet.inner], higher[near][feet.inner]
    return PointHeights(places[index], higher, lines[index])

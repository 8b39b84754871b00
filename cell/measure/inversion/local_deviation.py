"""How far a placed part is off its own drawing about one feature: bent, worn or cut there.

The part's pose follows from all of its faces, and passes over the few points that do not fit it. So the points about a
feature are asked by themselves: how much higher they stand than drawn at that pose, and where the part ends.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.inversion.disagreement import squares
from cell.measure.inversion.flush import PointHeights
from cell.measure.inversion.nominal import Array, NominalSurface
from cell.measure.reconstruction.cloud import Cloud

NEAR_M = 3e-3
"""The points within this of a feature are asked."""
LEVEL_M = (-0.3e-3, 1.5e-3)
"""So far below or above the nearest drawn point at most is one of the face, and not of the part's side."""
RIM_M, STEP_M = 2e-3, 0.02e-3
"""So far from an edge at most its rim is drawn, and in such steps it is looked for in the drawing."""
STRETCH_M = (-6e-3, 3.5e-3)
"""Outward of the drawn rim, where the part's last points are looked for."""
BAND_M, LEAST_BANDS = 1e-3, 4
"""They are looked for in bands across the rim, so wide, of which so many have to tell."""
BLUR_M = 0.15e-3
"""Half a stripe, of which a rim leaves the inner side: the last point is off by less."""
SECTORS, LEAST_SECTORS = 16, 12
"""The rim of a hole or a pin is looked for in so many sectors, of which so many have to tell."""
STRAY = 4.5
"""Median deviations from all sectors' middle, beside half a stripe, from which on one tells nothing."""
WIDE_M, NARROW_M = 15e-3, 1.5e-3
"""Radii between which such a rim is looked for."""
PAST_M = 0.5e-3
"""A sweep that sees anything so far beyond the rim has not ended before it."""
STEEP = 1.0
"""Rise over distance from which on what stands higher beside a rim may hide it from camera or laser."""


class Span(NamedTuple):
    """Between what the points about a feature say that something is off, m."""

    least: float
    most: float

    @property
    def off(self) -> float:
        """The least that explains the points; 0 where the drawing does."""
        return float(np.clip(0.0, self.least, self.most))

    @property
    def more(self) -> float:
        """By how much more it may be off; 0 where the drawing explains the points."""
        return self.most - self.least if self.off else 0.0


class Rim(NamedTuple):
    """A part ends by `farther` along `outward` (3,) than drawn, square to its edge and to the surface's z axis. A rim
    that may be hidden is never told to end too soon."""

    farther: Span
    outward: Array


@dataclass(frozen=True)
class LocalDeviation:
    """The points about a feature stand `higher` than drawn at the part's pose, along the surface's z axis, give or take
    four standard deviations. About an edge they show the part's `rim`, about a hole or a pin how far its `middle` lies
    aside in two directions; surface axes. None, or nothing, is what too few of them tell.
    """

    higher: Span | None = None
    rim: Rim | None = None
    middle: tuple[tuple[Span, Array], ...] = ()

    @property
    def spans(self) -> tuple[tuple[Span, Array], ...]:
        """Each span that is seen, with its direction (3,), surface axes."""
        up = () if self.higher is None else ((self.higher, np.array([0.0, 0.0, 1.0])),)
        return (*up, *(() if self.rim is None else (self.rim,)), *self.middle)


def higher_about(seen: PointHeights, at: Array, rocks: float = 0.0) -> Span | None:
    """How much higher than drawn the points `seen` stand about `at` (3,) m, surface frame; None where too few show. The
    vehicle `rocks` by so much, m, up and down: the points about a feature are swept together, at one end of that."""
    drawn = seen.places - np.outer(seen.higher, [0.0, 0.0, 1.0])
    near = np.linalg.norm(drawn - at, axis=1) < NEAR_M
    if not near.any():
        return None
    _, middle, noise = squares(np.zeros(near.sum(), dtype=np.intp), seen.higher[near], seen.lines[near])
    unsure = noise + 2.0 * rocks
    return Span(float(middle[0] - unsure[0]), float(middle[0] + unsure[0])) if len(middle) else None


def seen_rim(
    cloud: Cloud, base_from_surface: pin.SE3, lies: pin.SE3, *, faces: NominalSurface, at: Array, edge: Array
) -> Rim | None:
    """Where a part with these `faces`, which `lies` at surface_from_part, ends at its edge through `at` (3,) m along
    `edge` (3,), part frame, by the cloud of a sweep over it, arm base.

    None where no rim is drawn there, where level ground goes on beyond it, and where too few points show.
    """
    base_from_part, upward = base_from_surface * lies, lies.rotation[2]
    along = edge / np.linalg.norm(edge)
    across = np.cross(along, upward)
    if not (length := float(np.linalg.norm(across))) > 0.5:
        return None  # It stands upright.
    ways = [way for way in (across / length, -across / length) if _drawn_end(faces, at, way) is not None]
    if len(ways) != 1:
        return None
    beside = (cloud.points[cloud.valid] - base_from_part.translation) @ base_from_part.rotation - at
    out, aside = beside @ ways[0], beside @ along
    told = []
    for low in np.arange(-NEAR_M, NEAR_M - 0.5 * BAND_M, BAND_M):
        end = _drawn_end(faces, at + (low + 0.5 * BAND_M) * along, ways[0])
        if end is not None:
            band = (aside >= low) & (aside < low + BAND_M) & (out > end + STRETCH_M[0]) & (out < end + STRETCH_M[1])
            places = at + beside[band]
            ends = _ends(np.sort(out[band][_level(faces, places, at, upward)] - end))
            # Where the sweep sees what is below the face there is none of it.
            gone = not ends and _seen_below(faces, places[out[band] < end - PAST_M], upward)
            told += [(STRETCH_M[0], STRETCH_M[0])] if gone else ends
    if len(told) < LEAST_BANDS:
        return None
    last, beyond = map(float, np.median(told, axis=0))
    if beyond > STRETCH_M[1]:
        return None
    hidden = not (out[np.abs(aside) < NEAR_M] > PAST_M).any() or _hidden(faces.samples - at, upward)
    return Rim(Span(last - BLUR_M, max(beyond + BLUR_M, 0.0 if hidden else -np.inf)), lies.rotation @ ways[0])


def seen_middle(
    cloud: Cloud, base_from_surface: pin.SE3, lies: pin.SE3, *, faces: NominalSurface, at: Array, axis: Array
) -> tuple[tuple[Span, Array], ...]:
    """How far aside the middle of a hole or a pin lies, in two directions (3,) square to its `axis` (3,) and to each
    other, surface axes; as `seen_rim`. `at` (3,) m is drawn in the middle of a hole's mouth or of a pin's top.

    Nothing where no rim is drawn about it, where something rises over it, and where too little of its rim shows.
    """
    base_from_part, upward = base_from_surface * lies, lies.rotation[2]
    along = axis / np.linalg.norm(axis)
    if abs(along @ upward) < 0.5 or _hidden(faces.samples - at, upward):
        return ()
    one = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
    ways = np.array([one, np.cross(along, one)]) / np.linalg.norm(one)
    places = (cloud.points[cloud.valid] - base_from_part.translation) @ base_from_part.rotation
    flat = (places - at) @ ways.T
    turn = np.arctan2(flat[:, 1], flat[:, 0])
    rows, ends = [], []
    for angle in 2.0 * np.pi * np.arange(SECTORS) / SECTORS:
        side = np.array([np.cos(angle), np.sin(angle)])
        beside = np.abs(np.angle(np.exp(1j * (turn - angle)))) < np.pi / SECTORS
        if (end := _end_in_sector(faces, places[beside], at, side @ ways, upward)) is not None:
            rows.append([*side, 1.0])
            ends.append(end)
    if not rows:
        return ()
    # One that is wider moves its rim apart, and not its middle.
    sides, told = np.array(rows), np.array(ends)
    left = told.mean(axis=1) - sides @ np.linalg.lstsq(sides, told.mean(axis=1))[0]
    # A glint beside the rim is in one sector or another.
    kept = np.abs(left) <= BLUR_M + STRAY * float(np.median(np.abs(left)))
    if kept.sum() < LEAST_SECTORS:
        return ()
    aside = np.linalg.lstsq(sides[kept], told[kept].mean(axis=1))[0][:2]
    # As far as all sectors together may put it aside.
    half = 4.0 / np.pi * float(np.mean(0.5 * np.diff(told[kept], axis=1)))
    return tuple(
        (Span(float(by) - half, float(by) + half), lies.rotation @ way) for by, way in zip(aside, ways, strict=True)
    )


def _end_in_sector(
    faces: NominalSurface, places: Array, at: Array, way: Array, upward: Array
) -> tuple[float, float] | None:
    """Between how much farther along `way` (3,) than drawn, m, the rim about `at` lies by the points (n, 3) there."""
    if (drawn := _drawn_rim(faces, at, way, upward)) is None:
        return None
    rim, outward, room = drawn
    radius = float((rim - at) @ way)
    flat = (places - at) - np.outer((places - at) @ upward, upward)
    out, most = outward * (np.linalg.norm(flat, axis=1) - radius), min(STRETCH_M[1], room)
    near = (out > STRETCH_M[0]) & (out < most)
    # A mouth or a top is level: what lies deeper is a floor, or what the pin stands on.
    level = _level(faces, places[near], rim, upward, slope=0.0)
    ends = _ends(np.sort(out[near][level]))
    if not ends or ends[0][1] > most:
        return None
    least, beyond = ends[0][0] - BLUR_M, ends[0][1] + BLUR_M
    return (least, beyond) if outward > 0.0 else (-beyond, -least)


def _level(
    faces: NominalSurface, places: Array, rim: Array, upward: Array, *, slope: float = STEEP
) -> NDArray[np.bool_]:
    """Which of the points (n, 3), part frame, lie on the face that ends at the `rim` (3,): not on its side, nor on a
    face below it, to which it does not fall off by this `slope`."""
    index, feet = faces.feet(places, STRETCH_M[1])
    higher, beside = (places[index] - feet.points) @ upward, feet.points - rim
    below = -beside @ upward
    far = np.linalg.norm(beside + np.outer(below, upward), axis=1)
    level = np.zeros(len(places), dtype=np.bool_)
    level[index] = (higher > LEVEL_M[0]) & (higher < LEVEL_M[1]) & (below < LEVEL_M[1] + slope * far)
    return level


def _seen_below(faces: NominalSurface, places: Array, upward: Array) -> bool:
    """Whether enough of the points (n, 3), part frame, lie far below the drawn face."""
    _, feet = faces.feet(places)
    return int(((feet.points - places) @ upward > LEVEL_M[1]).sum()) > 2


def _drawn_rim(faces: NominalSurface, at: Array, way: Array, upward: Array) -> tuple[Array, float, float] | None:
    """Where along `way` (3,) from `at` a hole or a pin's top ends in the faces, (3,) m, 1 for a pin and -1 for a hole,
    and half of how far beyond the rim the next face as high is drawn, m; None where neither is drawn there."""
    places = at + np.outer(np.arange(0.0, WIDE_M, STEP_M), way)
    _, feet = faces.feet(places)
    apart = feet.points - places
    up = apart @ upward
    aside = np.linalg.norm(apart - np.outer(up, upward), axis=1)
    # The face about a mouth need not be level: above one that is inclined, the nearest point of it lies aside.
    on_face = (np.abs(up) < LEVEL_M[1]) & (aside < BLUR_M + STEEP * np.abs(up))
    changes = np.flatnonzero(on_face != on_face[0])
    if not len(changes):
        return None
    # Seen from beside it the nearest point of the faces is on the rim.
    beside, outward = (changes[0], 1.0) if on_face[0] else (changes[0] - 1, -1.0)
    rim = feet.points[beside]
    if not (radius := float((rim - at) @ way)) > NARROW_M:
        return None
    if outward < 0.0:
        return rim, outward, radius  # Beyond it is its other side.
    again = np.flatnonzero(on_face[beside:])
    return rim, outward, 0.5 * STEP_M * float(again[0]) if len(again) else np.inf


def _drawn_end(faces: NominalSurface, at: Array, outward: Array) -> float | None:
    """How far `outward` of `at` the faces end, m; None where they do not, or end elsewhere."""
    _, feet = faces.feet(at + np.outer(np.arange(-RIM_M, RIM_M, STEP_M), outward))
    # Beyond the rim the nearest point of the faces is on it.
    reach = (feet.points - at) @ outward
    drawn = feet.inner[0] and abs(feet.heights[0]) < LEVEL_M[1] and reach[-1] - reach[-2] < 0.1 * STEP_M
    return float(reach.max()) if drawn else None


def _ends(out: Array) -> list[tuple[float, float]]:
    """Between what the part ends in one band, if that shows: its last point, and where the next one would have been."""
    last = out[out > out.max(initial=-np.inf) - NEAR_M]
    return [(float(last[-1]), float(last[-1] + np.diff(last).max()))] if len(last) > 2 else []


def _hidden(beside: Array, upward: Array) -> bool:
    """Whether something of the part, (n, 3) m from its rim, rises steeply over it."""
    up = beside @ upward
    level = np.linalg.norm(beside - np.outer(up, upward), axis=1)
    return bool((up > np.maximum(LEVEL_M[1], STEEP * level)).any())

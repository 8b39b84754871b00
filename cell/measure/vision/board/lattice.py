"""Order among found dots or corners: a lattice grown from neighbour to neighbour, and which point is which.

Lattice places are whole steps along two neighbour vectors of the picture, so that perspective does not matter. Rings
settle which point is which on marked boards, even for a part of one; the others must be seen to all their edges.
`PlaneMap` takes a board's lattice to the picture: a homography, and what the lens adds near known points.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.view import BoardSpec
from cell.measure.vision.pictures import PictureRefused, Reason

Places = NDArray[np.intp]

# Least ring scores of the three rings: brightness of the middle, missing darkness.
RING_SCORES = (0.30, 0.12)
RING_LEAD = 1.6
# Of a board without marks that must be found, and points beside it that may be mistaken for part of it.
LEAST_SHARE = 0.5
MOST_OUTSIDE = 0.1
# With fewer of its points and not all of its edges it is more likely another board.
WHOLE_SHARE = 0.88
NEAREST = 4
TOLERANCE = 0.27
SIZE_RATIO = 1.7
SEEDS = 12
WAYS = ((0, 1), (0, -1), (1, 1), (1, -1))
"""Neighbours: axis and sign."""


@dataclass(frozen=True, eq=False)
class Blobs:
    """Elliptic blobs: centres (n, 2) in px and shape matrices (n, 2, 2) that map the unit circle to the ellipse."""

    centres: Array
    shapes: Array

    @property
    def areas(self) -> Array:
        """Areas (n,) of the ellipses in px²."""
        return np.asarray(np.pi * np.abs(np.linalg.det(self.shapes)), dtype=np.float64)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "Blobs":
        """The blobs of an index or a mask."""
        return Blobs(self.centres[index], self.shapes[index])


def dot_lattices(blobs: Blobs, least: int) -> Iterator[tuple[NDArray[np.intp], Places]]:
    """Lattices of at least `least` blobs, none sharing a blob: indices (m,) and places (m, 2). Right-handed as the
    picture is: the second step lies clockwise of the first, as y does of x."""
    n = len(blobs.centres)
    if n < least:
        return
    tree = scipy.spatial.cKDTree(blobs.centres)
    distances, neighbours = tree.query(blobs.centres, k=min(n, 9))
    near, who = np.asarray(distances), np.asarray(neighbours)
    # Seeds: dots whose neighbours are about as big as they are, the most regular surroundings first.
    areas = blobs.areas
    similar = np.mean(np.abs(np.log(areas[who] / areas[:, None])) < np.log(SIZE_RATIO), axis=1)
    order = np.lexsort((near[:, -1] / np.maximum(near[:, 1], 1e-9), -np.round(4 * similar)))

    def alike(a: int, b: int) -> bool:
        return bool(1 / SIZE_RATIO < areas[a] / areas[b] < SIZE_RATIO)

    seeds = Seeds(order, who, alike, first_steps=1, least_sine=0.35, most=SEEDS)
    yield from lattices(blobs.centres, tree, seeds, least)


@dataclass(frozen=True, eq=False)
class Seeds:
    """Where lattices may begin: points by the `order` in which they are tried, at most so many, and `neighbours` (n, k)
    of each, itself first.

    `alike(a, b)` says whether b can be a neighbour of a. The first of two steps goes to one of the `first_steps`
    nearest, the other is at an angle to it of at least `least_sine`.
    """

    order: NDArray[np.intp]
    neighbours: NDArray[np.intp]
    alike: Callable[[int, int], bool]
    first_steps: int
    least_sine: float
    most: int

    def basis(self, centres: Array, seed: int, fits: Callable[[int, int], bool]) -> tuple[Array, Array] | None:
        """The two shortest right-handed steps from the seed to neighbours that fit; None without such."""
        steps = [centres[k] - centres[seed] for k in self.neighbours[seed][1:].tolist() if fits(seed, k)]
        for k, first in enumerate(steps[: self.first_steps]):
            for second in steps[k + 1 :]:
                cross = first[0] * second[1] - first[1] * second[0]
                if abs(cross) > self.least_sine * np.linalg.norm(first) * np.linalg.norm(second):
                    return (first, second) if cross > 0 else (first, -second)
        return None


def lattices(
    centres: Array, tree: scipy.spatial.cKDTree, seeds: Seeds, least: int
) -> Iterator[tuple[NDArray[np.intp], Places]]:
    """Lattices of at least `least` of the points `centres` (n, 2), none sharing a point: indices and places (m, 2)."""
    free = np.ones(len(centres), dtype=np.bool_)

    def fits(a: int, b: int) -> bool:
        return bool(free[b]) and seeds.alike(a, b)

    tries = 0
    for seed in seeds.order.tolist():
        if not free[seed] or tries >= seeds.most:
            continue
        basis = seeds.basis(centres, seed, fits)
        if basis is None:
            continue
        tries += 1
        found = grow(centres, tree, seed, basis, fits)
        if len(found) >= least:
            index = np.array(list(found.values()), dtype=np.intp)
            free[index] = False
            yield index, np.array(list(found), dtype=np.intp)


def grow(
    centres: Array, tree: scipy.spatial.cKDTree, seed: int, basis: tuple[Array, Array],
    alike: Callable[[int, int], bool],
) -> dict[tuple[int, int], int]:  # fmt: skip
    """Place → point, from the seed outwards; each hands its own local steps to its neighbours. `alike(a, b)` says
    whether b can be a neighbour of a."""
    found = {(0, 0): seed}
    points: list[tuple[float, float]] = centres.tolist()
    steps = {seed: [(float(basis[0][0]), float(basis[0][1])), (float(basis[1][0]), float(basis[1][1]))]}
    latest = [(0, 0)]
    while latest:
        ways = [
            (place, axis, sign, (place[0] + sign * (not axis), place[1] + sign * axis))
            for place in latest
            for axis, sign in WAYS
        ]
        ways = [way for way in ways if way[3] not in found]
        if not ways:
            break
        guesses = [
            [points[found[place]][k] + sign * steps[found[place]][axis][k] for k in (0, 1)]
            for place, axis, sign, _ in ways
        ]
        near = [np.asarray(part).tolist() for part in tree.query(np.array(guesses))]
        latest = []
        for (place, axis, sign, beside), distance, blob in zip(ways, *near, strict=True):
            here = found[place]
            (x, y), own = points[here], steps[here]
            reach = TOLERANCE * min(math.hypot(*own[0]), math.hypot(*own[1]))
            if distance > reach or beside in found or blob in steps or not alike(here, blob):
                continue
            there = points[blob]
            local = list(own)
            local[axis] = sign * (there[0] - x), sign * (there[1] - y)
            steps[blob] = local
            found[beside] = blob
            latest.append(beside)
    return found


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """`homography` (3, 3) from lattice places to px, and the places (n, 2) with their residuals (n, 2) in px."""

    homography: Array
    places: Array
    residuals: Array

    @classmethod
    def fit(cls, places: Array | NDArray[np.intp], pixels: Array, tolerance: float, what: str) -> "PlaneMap":
        """Robust fit to places (n, 2) and pixels (n, 2); `tolerance` in px. Raises PictureRefused."""
        homography, used = cv2.findHomography(places.astype(np.float64), pixels, cv2.RANSAC, tolerance)
        if homography is None or used is None or used.sum() < 4:
            raise PictureRefused(Reason.NO_BOARD, f"the points found do not lie in a plane like those of {what}")
        keep = used.ravel() > 0
        plain = cls(np.asarray(homography, dtype=np.float64), np.zeros((0, 2)), np.zeros((0, 2)))
        kept = places[keep].astype(np.float64)
        return cls(plain.homography, kept, pixels[keep] - plain.pixels(kept))

    @cached_property
    def _near(self) -> scipy.spatial.cKDTree:
        return scipy.spatial.cKDTree(self.places)

    def pixels(self, places: Array | NDArray[np.intp]) -> Array:
        """Pixels (m, 2) of lattice places (m, 2)."""
        mapped = np.column_stack([places, np.ones(len(places))]) @ self.homography.T
        pixels = mapped[:, :2] / mapped[:, 2:]
        if len(self.places) >= NEAREST:
            distance, who = self._near.query(places, k=NEAREST)
            weight = 1.0 / (np.asarray(distance) + 0.1)
            weight /= weight.sum(axis=1, keepdims=True)
            pixels = pixels + np.einsum("mk,mkd->md", weight, self.residuals[np.asarray(who)])
        return np.asarray(pixels, dtype=np.float64)

    def steps(self, places: Array) -> Array:
        """∂pixel/∂place (m, 2, 2)."""
        mapped = np.column_stack([places, np.ones(len(places))]) @ self.homography.T
        pixels = mapped[:, :2] / mapped[:, 2:]
        h = self.homography
        by_place = (h[None, :2, :2] - pixels[:, :, None] * h[None, 2:, :2]) / mapped[:, 2, None, None]
        return np.asarray(by_place, dtype=np.float64)


def identify(spec: BoardSpec, places: Places, ring_scores: Array) -> tuple[Places, bool]:
    """Board places (n, 2) of lattice places (n, 2), and whether the order rests on an assumption. `ring_scores` (n, 2)
    are the signs of rings. Entries that do not belong to the board get (−1, −1). Raises PictureRefused."""
    if spec.kind != "marked_dots":
        # Of a symmetric board the order whose rows run most nearly along the first step.
        orders = by_outline(spec, places)
        allowed = {"dots": 4 if spec.cols == spec.rows else 2}.get(spec.kind, 2 if spec.symmetric else 1)
        if len(orders) > allowed:
            raise PictureRefused(
                Reason.AMBIGUOUS, f"the dots found fit {spec.name} in {len(orders)} ways; show the whole board"
            )
        return min(orders, key=lambda order: _lean(order, places)), spec.symmetric
    refused: PictureRefused | None = None
    for scores, least in zip(ring_scores.T, RING_SCORES, strict=True):
        try:
            return _by_rings(spec, places, scores, least), False
        except PictureRefused as reason:
            refused = refused or reason
    assert refused is not None
    raise refused


def _by_rings(spec: BoardSpec, places: Places, scores: Array, least: float) -> Places:
    order = np.argsort(scores)[::-1]
    if len(order) < 4 or scores[order[2]] < least or scores[order[2]] < RING_LEAD * max(scores[order[3]], 0.3 * least):
        raise PictureRefused(
            Reason.AMBIGUOUS,
            "the board's three rings are not all seen clearly, so its order is not certain; move nearer",
        )
    rings, fits = places[order[:3]], []
    for a, b, c in itertools.permutations(range(3)):
        two, down = rings[b] - rings[a], rings[c] - rings[a]
        if (two % 2).any():
            continue
        steps = np.column_stack([two // 2, down])
        determinant = round(float(np.linalg.det(steps)))
        if abs(determinant) != 1:
            continue
        inverse = np.round(np.linalg.inv(steps)).astype(np.intp)
        found = (places - rings[a]) @ inverse.T + np.array(spec.rings[0])
        inside = np.asarray(((found >= 0) & (found < (spec.cols, spec.rows))).all(axis=1), dtype=np.bool_)
        if inside.mean() > 0.9:
            fits.append((int(np.square(steps).sum()), determinant < 0, np.where(inside[:, None], found, -1)))
    if not fits:
        raise PictureRefused(
            Reason.NO_BOARD, f"the dots and rings found do not fit {spec.name}: is it the board that the set-up names?"
        )
    # A part of a board also fits it sheared and mirrored; a board's steps are the short ones.
    _, mirrored, found = min(fits, key=lambda fit: fit[:2])
    if mirrored:
        raise PictureRefused(
            Reason.MIRRORED, "the board is seen mirrored: the picture is flipped, or the board printed so"
        )
    return found


def by_outline(spec: BoardSpec, places: Places, least_share: float = LEAST_SHARE) -> list[Places]:
    """Every order (n, 2) of lattice places (n, 2) in which they fill the board's outline and reach all of its edges.

    Under every change of lattice steps that keeps handedness. Entries beside the board are (−1, −1). Raises
    PictureRefused when there is none.
    """
    template = spec.lattice()
    if spec.kind == "asymmetric_dots":
        # Neighbours along the diagonals are a lattice of their own.
        template = np.column_stack([(template[:, 0] + template[:, 1]) // 2, (template[:, 1] - template[:, 0]) // 2])
    number = {tuple(p): tuple(q) for p, q in zip(template.tolist(), spec.lattice().tolist(), strict=True)}
    most, best = _most_inside(places, template)
    if most < least_share * len(template) or len(places) - most > max(2, MOST_OUTSIDE * most):
        raise PictureRefused(
            Reason.NO_BOARD,
            f"{len(places)} points in a lattice of {_size(places)} were found, of which {most} fit the {len(template)} "
            f"of {spec.name}; show the whole board, or name the board that it is",
        )
    orders = [f for f in best if _spans(f, set(number), template)]
    if not orders:
        whole = most >= WHOLE_SHARE * len(template)
        raise PictureRefused(
            Reason.AMBIGUOUS if whole else Reason.NO_BOARD,
            f"the {most} points found, of {len(template)}, a lattice of {_size(places)}, do not reach all edges of "
            f"{spec.name}, so their order is not certain; show the whole board, or name the board that it is",
        )
    return [np.array([number.get(tuple(p), (-1, -1)) for p in f.tolist()], dtype=np.intp) for f in orders]


def _most_inside(places: Places, template: Places) -> tuple[int, list[Places]]:
    """How many of the places fall into the template at most, and all ways (n, 2) to lay them so; none without any."""
    inside, most = {tuple(p) for p in template.tolist()}, 0
    best: list[Places] = []
    for change in _changes():
        moved = places @ change.T
        for shift in _shifts(moved, template):
            found = moved + shift
            hits = sum(tuple(p) in inside for p in found.tolist())
            if hits > most:
                most, best = hits, [found]
            elif hits == most and hits > 0:
                best.append(found)
    return most, best


def _size(places: Places) -> str:
    """Steps that the lattice found is long and wide."""
    return "×".join(map(str, sorted((np.ptp(places, axis=0) + 1).tolist(), reverse=True)))


def _spans(found: Places, wanted: set[tuple[int, ...]], template: Places) -> bool:
    """True when the dots that fit reach all four edges of the board."""
    hits = np.array([p for p in found.tolist() if tuple(p) in wanted])
    x_low, y_low = template.min(axis=0)
    x_high, y_high = template.max(axis=0)
    (low_x, low_y), (high_x, high_y) = hits.min(axis=0), hits.max(axis=0)
    return bool(low_x == x_low and low_y == y_low and high_x == x_high and high_y == y_high)


def _lean(found: Places, places: Places) -> float:
    """Smallest for the order whose rows run most nearly along the first lattice step."""
    known = (found >= 0).all(axis=1)
    flat = np.column_stack([found[known], np.ones(known.sum())]).astype(np.float64)
    fit = np.linalg.lstsq(flat, places[known].astype(np.float64), rcond=None)[0]
    return float(-fit[0, 0])


def _changes() -> list[Places]:
    """Whole-number changes of lattice steps with determinant 1 and small entries."""
    entries = range(-2, 3)
    return [
        np.array([[a, b], [c, d]], dtype=np.intp)
        for a, b, c, d in itertools.product(entries, repeat=4)
        if a * d - b * c == 1
    ]


def _shifts(moved: Places, template: Places) -> list[Places]:
    """Translations that could lay the moved places on the template."""
    extent, wanted = np.ptp(moved, axis=0), np.ptp(template, axis=0)
    slack = extent - wanted
    if (np.abs(slack) > 3).any():
        return []
    base = template.min(axis=0) - moved.min(axis=0)
    ranges = [range(min(0, -int(s)), max(0, -int(s)) + 1) for s in slack]
    return [base + np.array(shift, dtype=np.intp) for shift in itertools.product(*ranges)]

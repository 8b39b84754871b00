"""Which dot of the board is which: lattice places to the board's own columns and rows, or a reason why not.

Rings settle it for marked boards, even for a part of one. The other boards must be seen to all their edges.
"""

from __future__ import annotations

import itertools

import numpy as np
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


def identify(spec: BoardSpec, places: Places, ring_scores: Array) -> tuple[Places, bool]:
    """Board places (n, 2) of lattice places (n, 2), and whether the order rests on an assumption.

    `ring_scores` (n, 2) are the signs of rings of `tell_dots`. Entries that do not belong to the board get
    (−1, −1). Raises PictureRefused.
    """
    if spec.kind != "marked_dots":
        return _by_edges(spec, places)
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
    rings = places[order[:3]]
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
        inside = _inside(spec, found)
        if inside.mean() > 0.9:
            if determinant < 0:
                raise PictureRefused(
                    Reason.MIRRORED, "the board is seen mirrored: the picture is flipped, or the board printed so"
                )
            return np.where(inside[:, None], found, -1)
    raise PictureRefused(
        Reason.NO_BOARD, f"the dots and rings found do not fit {spec.name}: is it the board that the set-up names?"
    )


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
    outside = len(places) - most
    if most < least_share * len(template) or outside > max(2, MOST_OUTSIDE * most):
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


def _by_edges(spec: BoardSpec, places: Places) -> tuple[Places, bool]:
    """The order of dots without marks. Of a symmetric board that whose rows run most nearly along the first step."""
    orders = by_outline(spec, places)
    allowed = {"dots": 4 if spec.cols == spec.rows else 2}.get(spec.kind, 2 if spec.symmetric else 1)
    if len(orders) > allowed:
        raise PictureRefused(
            Reason.AMBIGUOUS, f"the dots found fit {spec.name} in {len(orders)} ways; show the whole board"
        )
    return min(orders, key=lambda order: _lean(order, places)), spec.symmetric


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


def _inside(spec: BoardSpec, found: Places) -> NDArray[np.bool_]:
    return np.asarray(((found >= 0) & (found < (spec.cols, spec.rows))).all(axis=1), dtype=np.bool_)

"""Pieces of a line that are much wider or narrower than the rest of it: out of focus, or on what shines.

A picture teaches one width, and what differs from it by more than twice is not believed. Rows that stay without a
stripe so are read once more by themselves, and what they show is taken where it goes on from the rest of the line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from cell.measure.vision.stripe.careful.careful import Careful

Array = NDArray[np.float64]

LEAST_ROWS = 32
END_ROWS = 12
"""So many rows on either side of a seam tell whether the line goes on there."""
SEAM_ROWS = 3 * END_ROWS
LEAST_LINE, LEAST_SHARE = 0.3, 0.8
"""Shares of the picture's rows, and of a piece's, that have to show the line."""
MOST_LIGHT = 4.0
"""Times more or less light than the rest of the line: a laser has the same everywhere, a surface takes its share."""


def fill_gaps(line: Careful, read: Callable[[slice], Careful]) -> None:
    """Fill into `line` what `read` finds in its longer gaps, where that is the same line in another width."""
    seen = np.isfinite(line.centres)
    if seen.mean() < LEAST_LINE:
        return
    for gap in _gaps(seen):
        piece = read(gap)
        there = np.isfinite(piece.centres)
        if there.sum() < LEAST_ROWS or there.mean() < LEAST_SHARE or not _goes_on(line, gap, piece):
            continue
        for name in ("centres", "sigma", "amplitude", "width", "saturated", "rival", "misfit"):
            getattr(line, name)[gap] = getattr(piece, name)


def _gaps(seen: NDArray[np.bool_]) -> list[slice]:
    """Runs of rows that show little of the line, which lies right beside them."""
    share = np.convolve(
        np.pad(seen.astype(np.float64), END_ROWS // 2, "edge"), np.full(END_ROWS + 1, 1 / (END_ROWS + 1))
    )
    sparse = share[END_ROWS : END_ROWS + len(seen)] < LEAST_SHARE
    edges = np.flatnonzero(np.diff(np.r_[False, sparse, False]))
    beside = [
        (a, b, seen[max(0, a - SEAM_ROWS) : a].sum(), seen[b : b + SEAM_ROWS].sum()) for a, b in edges.reshape(-1, 2)
    ]
    return [slice(int(a), int(b)) for a, b, *ends in beside if b - a >= LEAST_ROWS and max(ends) >= END_ROWS]


def _goes_on(line: Careful, gap: slice, piece: Careful) -> bool:
    """Whether the piece meets the line at one of its ends, at least."""
    rows = np.flatnonzero(np.isfinite(line.centres))
    own = gap.start + np.flatnonzero(np.isfinite(piece.centres))
    before, after = rows[rows < gap.start][-END_ROWS:], rows[rows >= gap.stop][:END_ROWS]
    return any(
        _meet(_end(line, beside, 0), _end(piece, inner, gap.start))
        for beside, inner in ((before, own[:END_ROWS]), (after, own[-END_ROWS:]))
        if min(len(beside), len(inner)) == END_ROWS
    )


@dataclass(frozen=True)
class _End:
    """An end of a line: its middle `row`, `place` in px and `slope` there, its width in px and light in DN px."""

    row: float
    place: float
    slope: float
    width: float
    light: float


def _end(line: Careful, rows: NDArray[np.intp], first: int) -> _End:
    """Of `rows` of the picture, of which `first` is the line's first."""
    at = rows - first
    slope, place = np.polyfit(rows - rows.mean(), line.centres[at], 1)
    width, light = (float(np.median(values[at])) for values in (line.width, line.amplitude * line.width))
    return _End(float(rows.mean()), float(place), float(slope), width, light)


def _meet(one: _End, other: _End) -> bool:
    """Whether they lie on one straight line and have about as much light."""
    if abs(other.row - one.row) > SEAM_ROWS or not 1 / MOST_LIGHT < one.light / other.light < MOST_LIGHT:
        return False
    half = 0.5 * (other.row - one.row)
    apart = one.place + one.slope * half - (other.place - other.slope * half)
    return abs(apart) < max(1.0, 0.5 * max(one.width, other.width))
